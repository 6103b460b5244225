"""`avmsf fit`: a capture folder in, a field file out."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from avmsf._utils.caching import discard
from avmsf.bench.evaluation import split
from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.cli import INTERRUPTED
from avmsf.cli.alignment import describe_alignment
from avmsf.cli.modes import Method, finder
from avmsf.cli.printing import console, figure, print_json, say
from avmsf.cli.progress import FitBar
from avmsf.cli.scores import compare, parts_words, score_table, score_values
from avmsf.cli.writing import expect_writable
from avmsf.errors import FitError
from avmsf.field.automatic import Automatic
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.fit import fit
from avmsf.field.physics import Physics
from avmsf.field.recipes import GainRecipe
from avmsf.field.soundfield import SoundField
from avmsf.field.store import save
from avmsf.modal.extraction.extract import extract_once
from avmsf.pipeline.choice import all_recipes, recipe_for
from avmsf.pipeline.physics import BodyConfig, physics_of
from avmsf.pipeline.reconstruct import expect_on_object
from avmsf.scene.features import FeatureField
from avmsf.scene.featurestore import load_features

_FEW = 8
"""Recordings below which little is told of the gains between contacts."""


@dataclass(frozen=True)
class Options:
    """Fit a sound field to a capture and write it to one file.

    An interrupted fit leaves its state beside the output; the same command goes on from it to the same result.
    """

    capture: tyro.conf.Positional[Path]
    """Folder with impacts.csv and the wav files it names."""
    output: Annotated[Path, tyro.conf.arg(metavar="FIELD.safetensors")]
    """File to write the field to."""
    settings: Path | None = None
    """A capture.toml to use in place of the folder's own."""
    train_fraction: float | None = None
    """Fit to all recordings at this part of the places, spread as far apart as they go, and score the field on the
    others. Contacts nearer than 1 % of the extent of all are one place."""
    train_count: int | None = None
    """Likewise with so many places."""
    start: int = 0
    """Row of impacts.csv, counted from 0, whose place this choice starts from."""
    features: Path | None = None
    """File of features that `avmsf lift` wrote, in the frame of the contacts; without it positions on the surface."""
    gains: Literal["auto", "physics", "spline", "attention"] = "auto"
    """How gains are spread over the object: physics, by its elastic mode shapes, of a capture with a mesh; spline, by
    thin-plate splines; attention, by the paper's network on the features; auto, by physics or splines, whichever
    predicts training contacts better that are left out in turn."""
    body: BodyConfig = field(default_factory=BodyConfig)
    method: Method = "high-resolution"
    """How modes are found; see `avmsf modes --help`."""
    modes: int = 128
    """Most modes to keep."""
    json: bool = False
    """Print one JSON object on the standard output, all else on the standard error."""
    recipe: Literal["quick", "paper"] = "quick"
    """Where the settings below start from: quick takes seconds to minutes, paper has the paper's settings and takes
    hours without an accelerator. `--recipe paper --help` shows its values."""
    config: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)
    """Settings of the fit."""


@dataclass(frozen=True)
class PaperOptions(Options):
    """The same, starting from the paper's settings."""

    recipe: Literal["quick", "paper"] = "paper"
    config: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=lambda: PAPER)


@dataclass(frozen=True)
class _Recipe:
    recipe: Literal["quick", "paper"] = "quick"


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell, with the recipe's settings where they say nothing."""
    kind = {"quick": Options, "paper": PaperOptions}[recipe_of(words)]
    return tyro.cli(
        kind, prog="avmsf fit", args=words, description=Options.__doc__, config=(tyro.conf.FlagCreatePairsOff,)
    )


def recipe_of(words: Sequence[str]) -> str:
    """Return the recipe that the words name; it is read first, for it decides what all others start from."""
    chosen, _ = tyro.cli(_Recipe, args=words, add_help=False, return_unknown_args=True)
    return chosen.recipe


def run(options: Options) -> int:
    """Fit, write, and say what came of it; return 130 where Ctrl-C stopped it."""
    expect_writable(options.output)
    settings = None if options.settings is None else CaptureSettings.read(options.settings)
    capture = read_capture(options.capture, settings)
    train, test = part_contacts(
        capture.impacts, fraction=options.train_fraction, count=options.train_count, start=options.start
    )
    if options.features is None:
        features = features_of(capture, options.config)
    else:
        features = load_features(options.features)
        expect_on_object(capture.impacts, features.points)
    if len(train) < _FEW:
        say(f"{len(train)} recordings tell little of how loud modes are between contacts; {_FEW} or more tell much")
    # Before the modes: what is wrong with the object's shape shows in less time than they take.
    recipe = _recipe(options, capture, train, features)
    say(f"finding the modes of {len(train)} recordings, {train.duration:.3g} s at {train.sample_rate:g} Hz")
    modes = extract_once(train, finder(options.method, options.modes), _beside(options.output, "modes"))
    for sentence in describe_alignment(modes, train):
        say(sentence)
    say(f"fitting a field of {len(modes.bank)} modes")
    checkpoint = _beside(options.output, "checkpoint")
    try:
        with FitBar() as bar:
            fitted = fit(
                train,
                features,
                modes,
                options.config,
                gains=recipe,
                capture=capture.name,
                settings=capture.settings,
                checkpoint=checkpoint,
                progress=bar.show,
            )
    except KeyboardInterrupt:
        where = f"from {checkpoint}, or delete it" if checkpoint.exists() else "from the start of training"
        say(f"avmsf fit: interrupted; give the same command again to go on {where}")
        return INTERRUPTED
    except FitError:
        discard(_beside(options.output, "modes"))
        raise
    save(fitted, options.output)
    for ending in ("modes", "checkpoint"):
        discard(_beside(options.output, ending))
    scores = {} if test is None else compare(fitted, train, test, modes)
    screen = console(errors=options.json)
    if test is not None:
        title = f"{parts_words(train, test)}; lower is better"
        say(f"not trained on: {', '.join(test.names)}")
        screen.print(score_table(title, scores))
    report = fitted.origin.report
    if "choice" in report:
        for words in choice_words(report["gains"], report["choice"]):
            screen.print(words, soft_wrap=True)
    for words in suspect_words(fitted):
        screen.print(words, soft_wrap=True)
    screen.print(summary(fitted, len(train)), soft_wrap=True)
    screen.print(f"wrote {options.output}", soft_wrap=True)
    if options.json:
        print_json(
            {
                "field": str(options.output),
                "capture": capture.name,
                "recipe": options.recipe,
                "config": asdict(options.config),
                "modes": len(fitted.bank),
                "sample_rate": fitted.sample_rate,
                "trained_on": list(train.names),
                "tested_on": [] if test is None else list(test.names),
                "report": report,
                "scores": score_values(scores),
            }
        )
    return 0


def _recipe(options: Options, capture: Capture, train: Impacts, features: FeatureField) -> GainRecipe | Automatic:
    """Return how gains are spread."""

    def physics() -> Physics:
        if capture.surface is None:
            raise FitError("physics needs the object's shape: lay its mesh into the capture folder as surface.obj")
        cache = _beside(options.output, "bodies")
        return physics_of(capture.surface, options.body, impacts=train, cache=cache, tell=say)

    if options.gains == "auto":
        return all_recipes(physics, tell=say)
    return recipe_for(options.gains, {"attention": features}, physics)


def _beside(output: Path, ending: str) -> Path:
    """Return where a part of an unfinished fit is kept: beside the field that it will become."""
    return output.with_name(f"{output.name}.{ending}")


def features_of(capture: Capture, config: FitConfig) -> FeatureField:
    """Return the object's points: of its surface where there is one, else those that fill the contacts' box."""
    if capture.surface is None:
        say("the capture has no surface: points that fill the box of its contacts stand for the object")
        return FeatureField.from_contacts(capture.impacts.contacts)
    return FeatureField.from_mesh(capture.surface, generator=torch.Generator().manual_seed(config.seed))


def part_contacts(
    impacts: Impacts, *, fraction: float | None, count: int | None, start: int
) -> tuple[Impacts, Impacts | None]:
    """Return the recordings to fit to and those to score on, None where all are fitted to."""
    if count is not None and fraction is not None:
        raise FitError("expected --train-count or --train-fraction, found both: leave one of them out")
    if fraction is not None:
        return split(impacts, fraction=fraction, start=start)
    if count is not None:
        return split(impacts, count=count, start=start)
    return impacts, None


def choice_words(name: str, choice: Mapping[str, Any]) -> list[str]:
    """Say how gains are spread, and why."""
    errors, missing = choice.get("errors", {}), choice.get("missing", {})
    told = ", ".join(f"{each} {figure(error)}" for each, error in errors.items())
    words = [f"gains by {name}" + (f"; errors at training contacts left out in turn: {told}" if told else "")]
    return words + [f"not by {each}: {reason}" for each, reason in missing.items()]


def suspect_words(fitted: SoundField) -> list[str]:
    """Say which strikes disagree with all others, one a line."""
    suspects = fitted.origin.report.get("suspects", {})
    told = [f"left out of the gains, look at its row in impacts.csv: {words}" for words in suspects.values()]
    return [*told, "a strike whose label was exchanged with one of these may be among the others"] if told else []


def summary(fitted: SoundField, contacts: int) -> str:
    """Say in a sentence what a fit came to."""
    report = fitted.origin.report
    how = "chosen on validation contacts" if report.get("validated") else "as set"
    gains = report.get("gains", "attention")
    return (
        f"field of {fitted.origin.capture}: {len(fitted.bank)} modes from {contacts} recordings, gains by {gains}, "
        f"{report.get('damping', 'shared')} damping ({how}), {report.get('steps', fitted.origin.config.steps)} steps "
        "end to end"
    )
