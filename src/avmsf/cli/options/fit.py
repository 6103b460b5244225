"""Options of `avmsf fit`."""

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.capture.filenames import expect_views
from avmsf.cli.options.checks import OutputError, expect_device, expect_rows, read_settings
from avmsf.cli.options.common import Configured, Flag, option_of
from avmsf.cli.options.paths import CacheFolder, Existing, NewFile, PlotsFolder, SettingsFile
from avmsf.cli.options.settings import with_settings
from avmsf.errors import EvaluationError, FitError
from avmsf.fem.material import material_named
from avmsf.field.config import GainModelName
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import CACHE, PRESETS, PipelineConfig, Preset, TimeZero

Stage = Literal["gaussians", "features", "surface"]
_SUFFIXES: dict[Stage | None, tuple[str, ...]] = {
    None: (".safetensors",),
    "gaussians": (".ply",),
    "features": (".safetensors",),
    "surface": (".ply", ".obj", ".glb"),
}
"""Endings of the output, by the stage that is the last."""


@dataclass(frozen=True)
class Options(Configured):
    """Fit a sound field to a capture and write it to one file.

    CAPTURE holds impacts.csv, the recordings that it names, and what shows the object: a mesh, photographs, a video or
    Gaussians. A mesh is used before photographs. Without recordings, --material gives an approximate field. The output
    of each stage is cached, only what changed is computed again, and repeating an interrupted command continues it.
    """

    capture: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="CAPTURE"),
            Existing("a capture folder, or a mesh with --material", ("a folder", "a mesh or Gaussians")),
        ]
    ]
    """Capture folder; with --material also a folder without recordings, or a mesh."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FIELD.safetensors")] = None
    """File to write the field to, by default only the cache; with --until what that stage makes: gaussians .ply,
    features .safetensors, surface .ply, .obj or .glb."""
    until: Stage | None = None
    """Stop after a stage, which needs no recordings: 3D Gaussians fitted to the views, image features of the object's
    points, or the object's surface, a folder's own mesh or one reconstructed from its views, in meters."""
    cache: CacheFolder = None
    """Cache the output of each stage here, by default in CAPTURE/.avmsf."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    plots: PlotsFolder = None
    """With --until surface: draw the surface and two cross-sections to surface.png in this folder."""
    material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Compute an approximate field of an object without recordings from its shape and its material: ceramic, glass,
    wood, plastic, iron, polycarbonate or steel."""
    train_fraction: Annotated[float | None, tyro.conf.arg(metavar="FLOAT")] = None
    """Fit to all recordings at this fraction of the contacts, spread as far apart as possible, and compute the error
    at the others. Contacts closer than 1 % of the extent of all count as one."""
    train_count: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Fit to all recordings at this number of contacts, spread as far apart as possible."""
    start: int = 0
    """Row of impacts.csv, counted from 0, whose contact this choice starts from."""
    features: Annotated[
        Path | None,
        tyro.conf.arg(metavar="FEATURES.safetensors"),
        Existing("features, as avmsf fit --until features writes them", ("features",)),
    ] = None
    """Features written by --until features, in the frame of the contacts; by default those of the folder's views
    where the gain model reads features."""
    without_shape: Flag = False
    """Fit to the positions of the contacts alone, whatever shows the object's shape."""
    gain_model: GainModelName | None = None
    """How gains vary over the object, by default auto. auto: a Gaussian process over all kernel families, weighted by
    evidence; the elastic family needs a shape. network: the paper's attention network on image features. The others: a
    Gaussian process over one family, for study; symmetry needs a shape, visual image features."""
    extraction: ExtractionMethod | None = None
    """How modes are extracted, by default high-resolution; see `avmsf modes --help`."""
    modes: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Maximum number of modes, by default 128."""
    time_zero: TimeZero | None = None
    """Start of the sounds: onset, or peak (paper); by default that of capture.toml."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device for Gaussians (with gsplat), DINOv2, training end to end and the network; by default the GPU if there is
    one. Mode extraction, finite elements and the Gaussian process run on the CPU."""
    seed: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Random seed of all stages, by default 0."""
    preset: Preset = "default"
    """All settings. default: takes seconds to minutes. paper: everything as published, the middle of each published
    list; takes hours."""

    usual = PRESETS["default"]

    @cached_property
    def all_settings(self) -> PipelineConfig:
        """The preset with the settings that are given."""
        seeds = ("fit.seed", "scene.views.seed", "scene.splat.seed", "scene.lift.seed")
        options = {name: getattr(self, name) for name in ("gain_model", "extraction", "modes", "time_zero", "device")}
        return with_settings(
            PRESETS[self.preset], self.set, self.config, {**options, **dict.fromkeys(seeds, self.seed)}
        )

    @property
    def kept(self) -> Path:
        """The folder that caches the stages' outputs."""
        if self.cache is not None:
            return self.cache
        return self.capture / CACHE if self.capture.is_dir() else self.capture.parent / CACHE / self.capture.stem

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if self.output is not None:
            NewFile(_SUFFIXES[self.until]).check(self.output)
        if self.plots is not None and self.until != "surface":
            raise OutputError.expected("--until surface with it", self.until, name="--plots")
        config = self.all_settings
        expect_device(config.device, raising=FitError)
        self._check_split()
        settings = read_settings(self.capture, self.settings)
        if self.material is not None:
            material_named(self.material, option="--material")
        self._check_unused(config)
        if self.until is not None or (self.material is not None and self.capture.is_dir()):
            expect_views(self.capture, settings)
        elif self.material is None:
            if not self.capture.is_dir():
                advice = "--material NAME computes a field of a mesh without recordings"
                raise FitError.expected(
                    "a capture folder", got="a file", file=self.capture, name="--material", advice=advice
                )
            expect_rows(self.capture, settings)

    def _check_split(self) -> None:
        if self.train_count is not None and self.train_fraction is not None:
            raise FitError.expected("it or --train-fraction", got="both", name="--train-count", advice="leave one out")
        if self.train_fraction is not None and not 0.0 < self.train_fraction < 1.0:
            raise EvaluationError.expected(
                "a fraction of training contacts between 0 and 1, such as 0.75",
                self.train_fraction,
                name="--train-fraction",
            )

    def _check_unused(self, config: PipelineConfig) -> None:
        """Raise FitError for options that nothing would read."""
        given = {each.name for each in fields(self) if getattr(self, each.name) != each.default}
        for name in ("gain_model", "time_zero"):
            if getattr(config, name) != getattr(self.usual, name):
                given.add(name)
        if config.gain_model in ("auto", "elastic"):
            given.discard("gain_model")
        if config.body.supports == "try":
            given.add("body.supports")
        fitted = ("train_fraction", "train_count", "start", "features", "without_shape")
        unread = {"until": fitted, "material": (*fitted, "until", "time_zero", "gain_model", "body.supports")}
        for other, names in unread.items():
            for name in names if getattr(self, other) else ():
                if name in given:
                    chosen = getattr(self, other)
                    raise FitError.expected(
                        f"no --{other} with it", chosen, name=option_of(name), advice="leave one out"
                    )
        if self.start and self.train_fraction is None and self.train_count is None:
            raise FitError.expected("--train-fraction or --train-count with it", got="neither", name="--start")
