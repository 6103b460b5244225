"""`avmsf fit`: a capture folder in, a field file out."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from avmsf._utils.device import TRAINABLE, usable_device
from avmsf._utils.wording import counted
from avmsf.capture import CaptureSettings, Impacts, read_capture
from avmsf.cli import INTERRUPTED
from avmsf.cli.alignment import describe_alignment
from avmsf.cli.heartbeat import doing
from avmsf.cli.options.checks import read_settings
from avmsf.cli.options.fit import Options
from avmsf.cli.printing import console, next_command, next_step, print_json, say
from avmsf.cli.progress import FitBar
from avmsf.cli.scores import (
    body_warnings,
    compare,
    order_words,
    outlier_words,
    parts_words,
    quality_words,
    score_table,
    score_values,
)
from avmsf.cli.visuals import expect_shape
from avmsf.errors import FitError
from avmsf.evaluation.splits import Scores, split
from avmsf.features.store import load_features, read_report
from avmsf.field.sound_field import SoundField
from avmsf.field.store import save
from avmsf.pipeline.fitting import discard_unfinished, fit_capture, unfinished
from avmsf.pipeline.guess import guess_field, known_surface
from avmsf.pipeline.record import capture_settings_of, modes_words, with_record

_SHOWN = 8
"""Names of recordings in a line, at most."""


def run(options: Options) -> int:
    """Fit, write, and print a summary; return 130 where Ctrl-C stopped it."""
    usable_device(options.device, raising=FitError, kinds=TRAINABLE)
    known = read_settings(options.capture, options.settings)
    if options.material is not None:
        return _run_guess(options, options.material, known)
    capture = read_capture(options.capture, capture_settings_of(options.pipeline, known))
    if options.without_shape:
        capture = replace(capture, surface=None)
    elif options.features is None:
        expect_shape(options.capture, capture, views=False, verb="fit")
    train, test = part_contacts(
        capture.impacts, fraction=options.train_fraction, count=options.train_count, start=options.start
    )
    features, made = None, {}
    if options.features is not None:
        features, made = load_features(options.features), read_report(options.features)
    try:
        with FitBar() as bar:
            fitted, modes = fit_capture(
                capture,
                options.pipeline,
                train=train,
                features=features,
                features_report=made,
                output=options.output,
                log=say,
                progress=bar.show,
            )
    except KeyboardInterrupt:
        if not unfinished(options.output, "modes").exists():
            raise
        checkpoint = unfinished(options.output, "checkpoint")
        where = f"from {checkpoint}, or delete it" if checkpoint.exists() else "from the start of training"
        say(f"avmsf fit: interrupted; repeat the command to continue {where}")
        return INTERRUPTED
    screen = console(errors=options.json)
    for sentence in (*order_words(fitted), *describe_alignment(modes, train)):
        screen.print(sentence, soft_wrap=True)
    save(fitted, options.output)
    discard_unfinished(options.output)
    doing("comparing the field with the recordings that it was not fitted to")
    scores = {} if test is None else compare(fitted, train, test, modes)
    if test is not None:
        shown = ", ".join(test.names[:_SHOWN]) + f" and {len(test) - _SHOWN} more" * (len(test) > _SHOWN)
        say(f"not trained on: {shown}")
    print_fitted(screen, fitted, train, test, scores, options.output)
    screen.print(f"wrote {options.output}", soft_wrap=True)
    next_after_fit(options.output, trial=test is not None)
    warn_of_quality(fitted)
    if options.json:
        print_json(
            {
                **fitted_values(fitted, train, test, scores, options.output),
                "preset": options.preset,
                "config": asdict(options.config),
                "sample_rate": fitted.sample_rate,
            }
        )
    return 0


def print_fitted(
    screen: Console, fitted: SoundField, train: Impacts, test: Impacts | None, scores: Mapping[str, Scores], path: Path
) -> None:
    """Print the errors of a field in the file `path` at held-out recordings, the outliers, and its quality."""
    if test is not None:
        screen.print(score_table(f"{parts_words(train, test)}; lower is better", scores))
    poor = fitted.quality is not None and fitted.quality.level > 0
    for words in (
        *outlier_words(fitted),
        summary(fitted, len(train)),
        *body_warnings(fitted),
        *(() if poor else quality_words(fitted, path)),
    ):
        screen.print(words, soft_wrap=True)


def fitted_values(
    fitted: SoundField, train: Impacts, test: Impacts | None, scores: Mapping[str, Scores], path: Path
) -> dict[str, Any]:
    """Return what `--json` prints of a field in the file `path`, whichever command fitted it."""
    return {
        "field": str(path),
        "capture": fitted.origin.capture,
        "modes": int(fitted.is_mode.sum()),
        "supporting_poles": int((~fitted.is_mode).sum()),
        "trained_on": list(train.names),
        "tested_on": [] if test is None else list(test.names),
        "report": fitted.origin.report,
        "body": None if fitted.body is None else fitted.body.record(),
        "scores": score_values(scores),
        "quality": None if fitted.quality is None else fitted.quality.level,
    }


def _run_guess(options: Options, material: str, settings: CaptureSettings) -> int:
    """Compute a field without recordings, write it and print a summary."""
    guessed = guess_field(
        known_surface(options.capture, settings),
        material,
        body=options.body,
        modes=options.modes,
        config=options.config,
        settings=settings,
        name=settings.name or options.capture.resolve().stem,
        cache=unfinished(options.output, "bodies"),
        log=say,
    )
    guessed = with_record(guessed, options.pipeline, {})
    save(guessed, options.output)
    show_guess(guessed, options.output, json=options.json)
    return 0


def next_after_fit(output: Path, *, trial: bool) -> None:
    """Print what is useful after a fit: after a `trial` on a part of the recordings, a fit to all of them."""
    if trial:
        next_step("the same command without --train-fraction and --train-count, to fit to all recordings")
    else:
        next_command("avmsf render", output, "--position X Y Z -o impact.wav")


def warn_of_quality(fitted: SoundField) -> None:
    """Print last that a field is not better than averaging recordings, and what to do."""
    if fitted.quality is not None and fitted.quality.level > 0:
        say(str(fitted.quality))


def show_guess(guessed: SoundField, output: Path, *, json: bool) -> None:
    """Print a summary of a field without recordings in the file `output`."""
    screen = console(errors=json)
    for words in quality_words(guessed, output):
        screen.print(words, soft_wrap=True)
    screen.print(f"wrote {output}", soft_wrap=True)
    next_command("avmsf render", output, "--position X Y Z -o impact.wav")
    if json:
        report = guessed.origin.report
        values = {"field": str(output), "capture": guessed.origin.capture, "modes": len(guessed.bank)}
        print_json(values | {"sample_rate": guessed.sample_rate, "trained_on": [], "report": report})


def part_contacts(
    impacts: Impacts, *, fraction: float | None, count: int | None, start: int
) -> tuple[Impacts, Impacts | None]:
    """Return the recordings to fit to and those to score on, None where all are fitted to."""
    if fraction is not None:
        return split(impacts, fraction, start=start)
    if count is not None:
        return split(impacts, count, start=start)
    return impacts, None


def summary(fitted: SoundField, contacts: int) -> str:
    """Return the summary of a fit."""
    report, body = fitted.origin.report, fitted.body
    reason = f" ({report['damping_reason']})" if "damping_reason" in report else ""
    gains = report.get("gain_model", "attention")
    if body is not None:
        gained = report["credibility"]["with_body"] - report["credibility"]["without_body"]
        gains += (
            f" (most probable body: {body}; it raises the log likelihood of the gains at left-out contacts by "
            f"{gained:.1f} per mode)"
        )
    modes = modes_words(len(fitted.bank), int((~fitted.is_mode).sum()))
    return (
        f"field of {fitted.origin.capture}: {modes} from "
        f"{counted(contacts, 'recording')}, gains by {gains}, {report.get('damping', 'shared')} damping{reason}, "
        f"{counted(report.get('steps', fitted.origin.config.steps), 'step')} end to end"
    )
