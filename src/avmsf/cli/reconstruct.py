"""`avmsf reconstruct`: a capture folder with all that it shows and sounds like in, a field out."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from avmsf._utils.device import TRAINABLE, usable_device
from avmsf.capture import CaptureSettings, read_capture
from avmsf.cli import INTERRUPTED
from avmsf.cli.alignment import describe_alignment
from avmsf.cli.fit import part_contacts, preset_of, print_fitted, refuse_with_material, show_guess
from avmsf.cli.heartbeat import doing
from avmsf.cli.printing import console, figure, print_json, say, table
from avmsf.cli.progress import FitBar
from avmsf.cli.scenebar import SceneBar
from avmsf.cli.scenes import SceneOptions, features_words
from avmsf.cli.scores import compare, score_values
from avmsf.cli.writing import expect_writable
from avmsf.errors import FitError
from avmsf.field.config import FitConfig, GainModel
from avmsf.field.fit import Progress
from avmsf.field.store import load
from avmsf.files import copy_whole
from avmsf.modal.config import ExtractionMethod
from avmsf.pipeline.config import (
    PRESETS,
    BodyConfig,
    LiftConfig,
    PipelineConfig,
    Preset,
    SceneConfig,
    TimeZero,
    ViewsConfig,
)
from avmsf.pipeline.reconstruct import reconstruct, reconstruct_guess
from avmsf.pipeline.record import capture_settings_of
from avmsf.pipeline.stages import StageFolder
from avmsf.scene.splatconfig import SplatConfig


@dataclass(frozen=True)
class Options(SceneOptions):
    """Go all the way from a capture folder to a field: views, Gaussians, features, modes, gains.

    FOLDER also has impacts.csv and the wav files it names. Each stage's output is kept in the cache, only what changed
    is made anew, and an interrupted run goes on with the same command.
    """

    output: Annotated[Path | None, tyro.conf.arg(metavar="FIELD.safetensors")] = None
    """File to copy the field to."""
    material: str | None = None
    """Guess the field of an object without recordings from its shape and its material; see `avmsf fit --help`."""
    train_fraction: float | None = None
    """Fit to all recordings at this part of the places, spread as far apart as they go, and score the field on the
    others. Contacts nearer than 1 % of the extent of all are one place."""
    train_count: int | None = None
    """Likewise with so many places."""
    start: int = 0
    """Row of impacts.csv, counted from 0, whose place this choice starts from."""
    method: ExtractionMethod = "high-resolution"
    """How modes are found; see `avmsf modes --help`."""
    modes: int = 128
    """Most modes to keep."""
    time_zero: TimeZero | None = None
    """Where sounds start: onset, or peak (paper); capture.toml decides where this does not."""
    device: str | None = None
    """What computes: cpu, or cuda; the GPU where there is one. On it run the Gaussians
    (with gsplat), DINOv2, training end to end, its spectral loss
    and the network; the modes, clusters, finite elements and the Gaussian process run on the CPU."""
    json: bool = False
    """Print one JSON object on the standard output, all else on the standard error."""
    gain_model: GainModel = "auto"
    """How gains vary over the object; see `avmsf fit --help`."""
    body: BodyConfig = field(default_factory=BodyConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    splat: SplatConfig = field(default_factory=SplatConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    preset: Preset = "default"
    """Where all settings start from, from views to the fit; see `avmsf fit --help`. `--preset paper --help` shows its
    values."""
    fit: FitConfig = field(default_factory=FitConfig)

    @property
    def pipeline(self) -> PipelineConfig:
        """All settings as one."""
        scene = SceneConfig(self.views, self.splat, self.lift)
        start, place = self.time_zero, self.device
        return PipelineConfig(self.gain_model, self.body, scene, self.fit, self.method, self.modes, start, place)


@dataclass(frozen=True)
class PaperOptions(Options):
    """The same, starting from what the preset `paper` has otherwise."""

    gain_model: GainModel = PRESETS["paper"].gain_model
    method: ExtractionMethod = PRESETS["paper"].method
    lift: LiftConfig = field(default_factory=lambda: PRESETS["paper"].scene.lift)
    time_zero: TimeZero | None = PRESETS["paper"].time_zero
    preset: Preset = "paper"
    fit: FitConfig = field(default_factory=lambda: PRESETS["paper"].fit)


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell, with the preset's settings where they say nothing."""
    return tyro.cli(
        {"default": Options, "paper": PaperOptions}[preset_of(words)],
        prog="avmsf reconstruct",
        args=words,
        description=Options.__doc__,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def run(options: Options) -> int:
    """Reconstruct, and say what came of it; return 130 where Ctrl-C stopped it."""
    if options.output is not None:
        expect_writable(options.output)
    usable_device(options.device, raising=FitError, kinds=TRAINABLE)
    settings = capture_settings_of(options.pipeline, options.read_settings())
    if options.material is not None:
        return _run_guess(options, options.material, settings)
    capture = read_capture(options.folder, settings)
    train, test = part_contacts(
        capture.impacts, fraction=options.train_fraction, count=options.train_count, start=options.start
    )
    try:
        with SceneBar() as scene_bar, FitBar() as fit_bar, StageFolder(options.kept).lock("avmsf reconstruct"):
            made = reconstruct(
                options.folder,
                capture,
                train,
                options.pipeline,
                cache=options.kept,
                settings=settings,
                listener=scene_bar.listener,
                fitting=lambda progress: show_fit(progress, scene_bar, fit_bar),
            )
            fitted = load(made.field)
            if options.output is not None:
                copy_whole(made.field, options.output)
    except KeyboardInterrupt:
        say("avmsf reconstruct: interrupted; the same command goes on from where it was")
        return INTERRUPTED
    doing("comparing the field with the recordings that it was not fitted to")
    scores = {} if test is None else compare(fitted, train, test, made.modes)
    screen = console(errors=options.json)
    for sentence in describe_alignment(made.modes, train):
        screen.print(sentence, soft_wrap=True)
    if made.report:
        screen.print(features_words(made.report), soft_wrap=True)
    rows = [[each.stage, figure(each.seconds), "now" if each.fresh else "before"] for each in made.stages]
    screen.print(table("stages", ["stage", "seconds", "made"], rows))
    print_fitted(screen, fitted, train, test, scores, options.output or made.field)
    if made.surface is not None:
        screen.print(f"the object's surface is {made.surface}", soft_wrap=True)
    screen.print(f"the field is {made.field}", soft_wrap=True)
    if options.output is not None:
        screen.print(f"wrote {options.output}", soft_wrap=True)
    if options.json:
        print_json(
            {
                "field": str(options.output or made.field),
                "surface": None if made.surface is None else str(made.surface),
                "capture": capture.name,
                "preset": options.preset,
                "features_report": made.report,
                "stages": [asdict(each) for each in made.stages],
                "modes": len(fitted.bank),
                "trained_on": list(train.names),
                "tested_on": [] if test is None else list(test.names),
                "report": fitted.origin.report,
                "scores": score_values(scores),
            }
        )
    return 0


def _run_guess(options: Options, material: str, settings: CaptureSettings) -> int:
    """Guess, write, and say what it is."""
    refuse_with_material(options)
    try:
        with SceneBar() as bar, StageFolder(options.kept).lock("avmsf reconstruct"):
            made = reconstruct_guess(
                options.folder,
                material,
                options.pipeline,
                cache=options.kept,
                settings=settings,
                listener=bar.listener,
            )
            if options.output is not None:
                copy_whole(made, options.output)
    except KeyboardInterrupt:
        say("avmsf reconstruct: interrupted; the same command goes on from where it was")
        return INTERRUPTED
    show_guess(load(made), options.output or made, json=options.json)
    return 0


def show_fit(progress: Progress, scene_bar: SceneBar, fit_bar: FitBar) -> None:
    """Show the fit on a screen that holds one bar at a time."""
    scene_bar.stop()
    fit_bar.show(progress)
