"""Options of `avmsf fit`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

from avmsf.cli.options.checks import expect_capture, expect_device, expect_modes
from avmsf.cli.options.common import Flag, Printing, parse_options, preset_of, preset_values
from avmsf.cli.options.paths import NEW_TENSORS, Existing, SettingsFile
from avmsf.errors import EvaluationError, FitError
from avmsf.fem.material import material_named
from avmsf.field.config import FitConfig, GainModel
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import BodyConfig, PipelineConfig, Preset, SceneConfig, TimeZero


@dataclass(frozen=True)
class Options(Printing):
    """Fit a sound field to a capture and write it to one file.

    Without recordings, a mesh and --material give an approximate field. Repeat an interrupted command to continue it:
    its state is saved next to the output, and the result is the same.
    """

    capture: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="CAPTURE"),
            Existing("a capture folder, or a mesh with --material", ("a folder", "a mesh or Gaussians")),
        ]
    ]
    """Folder with impacts.csv and the recordings that it names; with --material, a folder with a mesh, or a mesh."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FIELD.safetensors"), NEW_TENSORS]
    """File to write the field to."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Compute an approximate field of an object without recordings from its mesh and its material: ceramic, glass,
    wood, plastic, iron, polycarbonate or steel."""
    train_fraction: float | None = None
    """Fit to all recordings at this fraction of the contacts, spread as far apart as possible, and compute the error
    at the others. Contacts closer than 1 % of the extent of all count as one."""
    train_count: int | None = None
    """Fit to all recordings at this number of contacts, spread as far apart as possible."""
    start: int = 0
    """Row of impacts.csv, counted from 0, whose contact this choice starts from."""
    features: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FEATURES.safetensors"),
        Existing("features, as avmsf features writes them", ("features",)),
    ] = None
    """Features written by `avmsf features`, in the frame of the contacts; by default positions on the surface."""
    without_shape: Flag = False
    """Fit to the positions of the contacts alone, whatever shows the object's shape."""
    gain_model: GainModel = "auto"
    """How gains vary over the object. auto: a Gaussian process over all kernel families, weighted by evidence; the
    elastic family needs a mesh. network: the paper's attention network on the features. The others: a Gaussian process
    over one family, for study; symmetry needs a mesh, visual needs --features."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Finite-element models."""
    extraction: ExtractionMethod = "high-resolution"
    """How modes are extracted; see `avmsf modes --help`."""
    modes: int = 128
    """Maximum number of modes."""
    time_zero: TimeZero | None = None
    """Start of the sounds: onset, or peak (paper); by default that of capture.toml."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device for training end to end, its spectral loss and the network; by default the GPU if there is one. Mode
    extraction, clustering, finite elements and the Gaussian process run on the CPU."""
    preset: Preset = "default"
    """Defaults of all settings. default: takes seconds to minutes. paper: everything as published, the middle of each
    published list; takes hours. `--preset paper --help` shows its values. Features are those of --features; `avmsf
    reconstruct` computes the preset's."""
    config: Annotated[tyro.conf.OmitArgPrefixes[FitConfig], tyro.conf.arg(name="fit")] = field(
        default_factory=FitConfig
    )
    """How the field is fitted."""

    @property
    def pipeline(self) -> PipelineConfig:
        """All settings as one; those of views and features are in the features' file."""
        scene, start = SceneConfig(), self.time_zero
        return PipelineConfig(
            self.gain_model, self.body, scene, self.config, self.extraction, self.modes, start, self.device
        )

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        expect_device(self.device, raising=FitError)
        expect_modes(self.modes)
        expect_split(self.train_fraction, self.train_count)
        if self.material is None:
            expect_capture(self.capture, self.settings)
        else:
            material_named(self.material, option="--material")
            refuse_with_material(self)


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell, with the preset's settings as defaults."""
    values = preset_values(preset_of(words), fit="config")
    # Views and features are made beforehand.
    del values["scene"]
    return parse_options(partial(Options, **values), "fit", words)


def expect_split(fraction: float | None, count: int | None) -> None:
    """Raise `FitError` for both a fraction and a count, `EvaluationError` for a fraction that is no part."""
    if count is not None and fraction is not None:
        raise FitError("expected --train-count or --train-fraction, got both; leave one out", name="--train-count")
    if fraction is not None and not 0.0 < fraction < 1.0:
        raise EvaluationError.expected(
            "a fraction of training contacts between 0 and 1, such as 0.75", fraction, name="--train-fraction"
        )


def refuse_with_material(options: Any) -> None:
    """Raise FitError for options of `fit` or `reconstruct` that need recordings, given with --material."""
    names = ("train_fraction", "train_count", "features")
    given = [name for name in names if getattr(options, name, None) is not None]
    if options.gain_model not in ("auto", "elastic"):
        given.append("gain_model")
    if options.body.supports == "try":
        given.append("body.supports")
    if options.time_zero is not None:
        given.append("time_zero")
    if given:
        option = f"--{given[0].replace('_', '-')}"
        raise FitError(
            f"{option}: expected recordings, got --material, which computes a field without them; leave one out",
            name=option,
            value="--material",
        )
