"""`avmsf fit`: a capture folder in, a field file out, or what a stage before it makes; of many, a folder of these."""

import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from avmsf._utils.text import format_number, listed
from avmsf.capture.filenames import expect_views
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.cli.info import describe_shape, draw_field
from avmsf.cli.many import Many, run_many
from avmsf.cli.options import Configured, Device, Flag, Int, Name, Number, expect_capture, option_of, with_settings
from avmsf.cli.output import command, display, finish, show
from avmsf.cli.paths import CacheFolder, Existing, New, OutputError, PlotsFolder, arg, expect_free
from avmsf.errors import FitError
from avmsf.fem.material import material_named
from avmsf.field.config import GainModelName
from avmsf.pipeline.config import CACHE, PRESETS, PipelineConfig, Preset

if TYPE_CHECKING:
    from avmsf.evaluation.scores import Scores
    from avmsf.features.feature_field import FeatureField
    from avmsf.field.sound_field import SoundField
    from avmsf.pipeline.stages import StageFolder

_STAGES = {"field.safetensors": "fit", "points.safetensors": "features"}
"""Names of stages that are not those of their files."""
Stage = Literal["gaussians", "features", "surface"]
_SUFFIXES: dict[Stage | None, tuple[str, ...]] = {
    None: (".safetensors",),
    "gaussians": (".ply",),
    "features": (".safetensors",),
    "surface": (".ply", ".obj", ".glb"),
}
"""Endings of the output, by the stage that is the last."""
_MESH_KINDS: dict[str, Literal["obj", "glb"]] = {".obj": "obj", ".glb": "glb"}
_RENDER = "--position X Y Z -o impact.wav"


@dataclass(frozen=True)
class Options(Configured, Many):
    """Fit a sound field to a capture and write it to one file.

    A capture holds impacts.csv, the recordings that it names, and a mesh, photographs, a video or Gaussians, of which a
    mesh is used first. Without recordings, --material gives an approximate field. The output of each stage is cached.
    Of several captures, -o is a folder: it gets a file of each, and a table.
    """

    inputs: tyro.conf.Positional[
        Annotated[
            tuple[Path, ...],
            arg("CAPTURE ..."),
            Existing("a capture folder, or a mesh with --material", ("a folder", "a mesh or Gaussians")),
        ]
    ]
    """Capture folders, or with --material meshes."""
    output: Annotated[Path | None, arg("FILE", "-o")] = None
    """The field (.safetensors), by default in the cache; with --until .ply, .obj, .glb, .safetensors."""
    overwrite: Flag = False
    """Replace also what is no unedited field of the same capture."""
    until: Annotated[Stage | None, arg("STAGE")] = None
    """Stop after gaussians, features or surface."""
    cache: CacheFolder = None
    """Cache of the stages, by default CAPTURE/.avmsf."""
    plots: PlotsFolder = None
    """Draw what is made, as `avmsf info --plots` does."""
    material: Name = None
    """Approximate field without recordings: of ceramic, glass, wood, plastic, iron, polycarbonate or steel."""
    train_fraction: Number = None
    """Fit to this part of contacts, score the others."""
    train_count: Int = None
    """Fit to so many, spread; score the others."""
    features: Annotated[
        Path | None, arg("FILE"), Existing("features, as avmsf fit --until features writes them", ("features",))
    ] = None
    """Features in place of those of the views."""
    allow_missing_features: Flag = False
    """paper: without image features if there are none."""
    without_shape: Flag = False
    """Fit to the positions of the contacts alone."""
    gain_model: Annotated[GainModelName | None, arg("NAME")] = None
    """auto (default), network (paper), smooth, thin-plate, symmetry, visual or elastic."""
    device: Device = None
    """For views and training, by default the GPU."""
    seed: Int = None
    """Random seed of all stages, by default 0."""
    preset: Annotated[Preset, arg("default|paper")] = "default"
    """paper: all settings as published; takes hours."""

    usual = PRESETS["default"]
    alone = ("features",)

    @property
    def capture(self) -> Path:
        """The capture, where there is one."""
        return self.inputs[0]

    def of(self, given: Path, output: Path) -> "Options":
        """Return the options for one of many captures."""
        cache, plots = (None if each is None else each / output.name for each in (self.cache, self.plots))
        path = output.with_name(f"{output.name}{_SUFFIXES[self.until][0]}")
        # What has a record is this command's own, and may be made again; a field says itself whose it is.
        recorded = self.until is not None and path.with_name(f"{path.name}.stage.json").exists()
        overwrite = self.overwrite or recorded
        return replace(self, inputs=(given,), output=path, cache=cache, plots=plots, overwrite=overwrite)

    def cells(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return what the table of many shows of a field."""
        errors = {
            "by leave-one-out": values.get("report", {}).get("quality", {}).get("error"),
            "relative STFT error": values.get("scores", {}).get("field", {}).get("relative_stft"),
        }
        shown = {head: "" if error is None else format_number(error) for head, error in errors.items()}
        left_out = ", ".join(values.get("report", {}).get("excluded", ()))
        return {"modes": str(values.get("modes", "")), **shown, "outliers left out": left_out}

    @cached_property
    def all_settings(self) -> PipelineConfig:
        """The preset with the settings that are given."""
        seeds = ("fit.seed", "scene.views.seed", "scene.splat.seed", "scene.lift.seed")
        options = {"gain_model": self.gain_model, "device": self.device, **dict.fromkeys(seeds, self.seed)}
        options["allow_missing_features"] = self.allow_missing_features or None
        return with_settings(PRESETS[self.preset], self.set, self.config, options)

    @property
    def stages(self) -> "StageFolder":
        """The folder that caches the stages' outputs."""
        from avmsf.pipeline.stages import StageFolder

        own = self.capture / CACHE if self.capture.is_dir() else self.capture.parent / CACHE / self.capture.stem
        return StageFolder(self.cache or own)

    def _check(self) -> None:
        if not self.several:
            self._check_capture()
        config = self.all_settings
        if not self.several and self.output is not None:
            New(_SUFFIXES[self.until]).check(self.output)
            source, guess = self.capture, self.material is not None
            own = settings_of(source).name or (source.resolve().name if source.is_dir() else source.resolve().stem)
            capture = own if self.until is None else None
            expect_free(self.output, overwrite=self.overwrite, capture=capture, guess=guess)
        if self.material is not None:
            material_named(self.material, option="--material")
        self._check_unused(config)

    def _check_capture(self) -> None:
        """Raise for a capture that is not there, or not whole."""
        if self.until is not None or (self.material is not None and self.capture.is_dir()):
            expect_views(self.capture, settings_of(self.capture))
        elif self.material is None:
            if not self.capture.is_dir():
                wanted, advice = "a capture folder", "--material NAME computes a field of a mesh without recordings"
                raise FitError.expected(wanted, got="a file", file=self.capture, name="--material", advice=advice)
            expect_capture(self.capture)

    def _check_unused(self, config: PipelineConfig) -> None:
        """Raise FitError for options that nothing would read."""
        given = {each.name for each in fields(self) if getattr(self, each.name) != each.default}
        given |= {name for name in ("gain_model", "time_zero") if getattr(config, name) != getattr(self.usual, name)}
        given -= {"gain_model"} if config.gain_model in ("auto", "elastic") else set()
        given |= {"body.supports"} if config.body.supports == "try" else set()
        fitted = ("train_fraction", "train_count", "features", "without_shape")
        for other, chosen, names in (
            ("until", self.until, fitted),
            ("material", self.material, (*fitted, "until", "time_zero", "gain_model", "body.supports")),
        ):
            for name in (each for each in names if chosen and each in given):
                wanted, advice = f"no --{other} with it", "leave one out"
                raise FitError.expected(wanted, chosen, name=option_of(name), advice=advice)
        if self.train_count is not None and self.train_fraction is not None:
            raise FitError.expected("it or --train-fraction", got="both", name="--train-count", advice="leave one out")
        if self.train_fraction is not None and not 0 < self.train_fraction < 1:
            wanted, advice = "a fraction of the contacts between 0 and 1", "give their number by --train-count"
            raise FitError.expected(wanted, self.train_fraction, name="--train-fraction", advice=advice)


def run(options: Options) -> int:
    """Fit, write, and print a summary."""
    if options.several:
        return run_many("fit", options, raising=FitError)
    from avmsf._utils.device import TRAINABLE, usable_device

    usable_device(options.all_settings.device, raising=FitError, kinds=TRAINABLE)
    settings, stages = settings_of(options.capture).starting(options.all_settings.time_zero), options.stages
    if options.until is not None:
        return _make_stage(options, settings, stages)
    if options.material is not None:
        return _guess(options, options.material, settings, stages)
    return _fit(options, settings, stages)


def _fit(options: Options, settings: CaptureSettings, stages: "StageFolder") -> int:
    from avmsf.capture import read_capture
    from avmsf.cli.report import compare, features_lines, field_lines, parts_words, score_table
    from avmsf.evaluation.splits import split
    from avmsf.modal.extraction.alignment_report import AlignmentReport
    from avmsf.pipeline.fit import fit_in_stages
    from avmsf.pipeline.visual_checks import expect_shape

    capture, config, listener = read_capture(options.capture, settings), options.all_settings, display.listener
    size = options.train_count if options.train_fraction is None else options.train_fraction
    train, test = (capture.impacts, None) if size is None else split(capture.impacts, size)
    if options.without_shape:
        capture = replace(capture, surface=None, folder=None)
    elif options.features is None:
        expect_shape(capture)
    features, described = (None, None) if options.features is None else _given_features(options, options.features)
    with stages.lock("avmsf fit"):
        made = fit_in_stages(
            capture, config, stages, train=train, features=features, features_report=described, listener=listener
        )
        fitted, path = _written(made.field, options.output)
    aligned = AlignmentReport.of(made.modes, train)
    lines = [] if aligned is None else aligned.sentences() if display.verbose else aligned.warnings()
    lines += features_lines(made.report) if display.verbose else []
    scores: dict[str, Scores] = {}
    if test is not None:
        scores = compare(fitted, train, test, made.modes)
        lines.append(score_table(f"{parts_words(train, test)}; lower is better", scores))
        lines += [f"not trained on: {listed(test.names, most=8)}"] if display.verbose else []
    lines += field_lines(fitted, path, settings=display.verbose)
    lines += [f"wrote {path}", *([] if made.surface is None else [f"the object's surface is {made.surface}"])]
    show("\n".join(lines))
    if options.plots is not None:
        draw_field(fitted, options.plots, recorded=None if test is None else made.modes.aligned(test))
    values = {
        "field": str(path),
        "capture": fitted.origin.capture,
        "preset": options.preset,
        "config": asdict(config.fit),
        "modes": int(fitted.is_mode.sum()),
        "supporting_poles": int((~fitted.is_mode).sum()),
        "sample_rate": fitted.sample_rate,
        "trained_on": list(train.names),
        "tested_on": [] if test is None else list(test.names),
        "scores": {name: each.mean() for name, each in scores.items()},
        "quality": None if fitted.quality is None else fitted.quality.level,
        "body": None if fitted.body is None else fitted.body.record(),
        "report": fitted.origin.report,
        "surface": None if made.surface is None else str(made.surface),
        "features_report": made.report,
        "stages": [
            {"stage": _STAGES.get(name, Path(name).stem), "seconds": each.seconds, "fresh": each.fresh}
            for name, each in made.stages.items()
        ],
    }
    again = "the same command without --train-fraction and --train-count fits all recordings"
    return finish("", values, command("avmsf render", path, _RENDER) if test is None else again)


def _given_features(options: Options, path: Path) -> "tuple[FeatureField, dict[str, Any]]":
    """Return the features of a file, and how they were made; note where not as a preset other than the default does."""
    from avmsf.features.feature_field import load_features, read_report

    described = read_report(path)
    made, wanted = described.get("scene", {}).get("lift", {}), asdict(options.all_settings.scene.lift)
    other = [f"{name} {value!r}" for name, value in made.items() if name in wanted and value != wanted[name]]
    if options.preset != "default" and other:
        display.listener.note(f"features of other settings than the preset {options.preset}: {', '.join(other)}")
    return load_features(path), described


def _written(made: Path, output: Path | None) -> "tuple[SoundField, Path]":
    """Return a field in the cache, and where it is for the user: in a copy, if one is asked for."""
    from avmsf._utils.files import copy_whole
    from avmsf.field.store import load

    field = load(made)
    if output is not None:
        copy_whole(made, output)
    return field, output or made


def _guess(options: Options, material: str, settings: CaptureSettings, stages: "StageFolder") -> int:
    """Compute a field without recordings, and print a summary."""
    from avmsf.cli.report import quality_words
    from avmsf.pipeline.fit import guess_in_stages

    config, listener = options.all_settings, display.listener
    with stages.lock("avmsf fit"):
        made = guess_in_stages(options.capture, material, config, stages, settings=settings, listener=listener)
        guessed, path = _written(made, options.output)
    values = {"field": str(path), "capture": guessed.origin.capture, "modes": len(guessed.bank)}
    values |= {"sample_rate": guessed.sample_rate, "trained_on": [], "report": guessed.origin.report}
    if options.plots is not None:
        draw_field(guessed, options.plots)
    text = "\n".join([*quality_words(guessed, path), f"wrote {path}"])
    return finish(text, values, command("avmsf render", path, _RENDER))


def _make_stage(options: Options, settings: CaptureSettings, stages: "StageFolder") -> int:
    """Make Gaussians, features or a surface of the folder's views, and print what they are."""
    from avmsf._utils.files import copy_whole, write_whole
    from avmsf.capture.checks import check_one_unit, find_surface, readable_impacts
    from avmsf.capture.proposals import contacts_of
    from avmsf.mesh.surface import Surface
    from avmsf.pipeline.scene import CLOUD, SceneStages
    from avmsf.pipeline.shape import keep_surface, object_shape

    folder, words = options.capture, "-o field.safetensors"
    check_one_unit(folder, settings)
    config, listener = options.all_settings, display.listener
    scene = SceneStages(folder, stages, config.scene, settings=settings, listener=listener, device=config.device)
    scene.expect_any()
    contacts = contacts_of(readable_impacts(folder, settings))
    with stages.lock("avmsf fit"):
        match options.until:
            case "gaussians":
                made = scene[CLOUD]
            case "features":
                made = scene.features
                model = "--preset paper" if options.preset == "paper" else "--gain-model visual"
                words = f"--features {shlex.quote(str(options.output or made.path))} {model} {words}"
            case _:
                made = keep_surface(scene, *object_shape(find_surface(folder, settings), scene))
        path = options.output or made.path
        kind = _MESH_KINDS.get(path.suffix.lower())
        if kind is not None:
            write_whole(path, partial(Surface.read(made.path).write, kind=kind), raising=OutputError)
        elif options.output is not None:
            copy_whole(made.path, options.output)
        values = describe_shape(path, options.plots, contacts)
    return finish(f"wrote {path}", values, command("avmsf fit", folder, words))
