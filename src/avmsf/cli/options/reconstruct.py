"""Options of `avmsf reconstruct`."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.capture.settings import CaptureSettings
from avmsf.cli.options.checks import expect_modes, expect_rows
from avmsf.cli.options.common import Flag, parse_options, preset_of, preset_values
from avmsf.cli.options.fit import expect_split, refuse_with_material
from avmsf.cli.options.paths import NEW_TENSORS
from avmsf.cli.options.scenes import SceneOptions, with_seed
from avmsf.fem.material import material_named
from avmsf.field.config import FitConfig, GainModel
from avmsf.gaussians.config import SplatConfig
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import BodyConfig, LiftConfig, PipelineConfig, Preset, SceneConfig, TimeZero, ViewsConfig


@dataclass(frozen=True)
class Options(SceneOptions):
    """Make a field from a capture folder with photographs or a mesh: Gaussians, features, modes, gains.

    FOLDER also holds impacts.csv and the recordings that it names. The output of each stage is cached, only what
    changed is computed again, and repeating an interrupted command continues it.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FIELD.safetensors"), NEW_TENSORS] = None
    """Copy the field to this file."""
    material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Compute an approximate field without recordings from shape and material; see `avmsf fit --help`."""
    train_fraction: float | None = None
    """Fit to all recordings at this fraction of the contacts, spread as far apart as possible, and compute the error
    at the others. Contacts closer than 1 % of the extent of all count as one."""
    train_count: int | None = None
    """Fit to all recordings at this number of contacts, spread as far apart as possible."""
    start: int = 0
    """Row of impacts.csv, counted from 0, whose contact this choice starts from."""
    extraction: ExtractionMethod = "high-resolution"
    """How modes are extracted; see `avmsf modes --help`."""
    modes: int = 128
    """Maximum number of modes."""
    time_zero: TimeZero | None = None
    """Start of the sounds: onset, or peak (paper); by default that of capture.toml."""
    seed: int | None = None
    """Seed of all stages; by default each stage's own."""
    without_shape: Flag = False
    """Go on where nothing that shows the object can be used, with the positions of the contacts alone."""
    gain_model: GainModel = "auto"
    """How gains vary over the object; see `avmsf fit --help`."""
    body: BodyConfig = field(default_factory=BodyConfig)
    """Finite-element models."""
    views: ViewsConfig = field(default_factory=ViewsConfig)
    """How views are made."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How Gaussians are fitted."""
    lift: LiftConfig = field(default_factory=LiftConfig)
    """How features are made."""
    preset: Preset = "default"
    """Defaults of all settings, from views to the fit; see `avmsf fit --help`. `--preset paper --help` shows its
    values."""
    fit: FitConfig = field(default_factory=FitConfig)
    """How the field is fitted."""

    @property
    def pipeline(self) -> PipelineConfig:
        """All settings as one."""
        scene = with_seed(SceneConfig(self.views, self.splat, self.lift), self.seed)
        fit = self.fit if self.seed is None else replace(self.fit, seed=self.seed)
        start = self.time_zero
        return PipelineConfig(self.gain_model, self.body, scene, fit, self.extraction, self.modes, start, self.device)

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        expect_modes(self.modes)
        expect_split(self.train_fraction, self.train_count)
        if self.material is not None:
            material_named(self.material, option="--material")
            refuse_with_material(self)

    def expect_folder(self, settings: CaptureSettings) -> None:
        """Raise `CaptureError` for a table that cannot be used; only without recordings the folder needs views."""
        if self.material is None:
            expect_rows(self.folder, settings)
        else:
            super().expect_folder(settings)


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell, with the preset's settings as defaults."""
    values = preset_values(preset_of(words))
    scene = values.pop("scene")
    values |= {each.name: getattr(scene, each.name) for each in fields(scene)}
    return parse_options(partial(Options, **values), "reconstruct", words)
