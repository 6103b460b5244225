"""A field and the baselines, at held-out contacts."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from avmsf._utils.text import counted, format_number
from avmsf.capture import Impacts
from avmsf.capture.impacts import places_of
from avmsf.cli.heartbeat import verbosity
from avmsf.cli.printing import table
from avmsf.evaluation.scores import Scores, evaluate, score
from avmsf.evaluation.simple_methods import MeanGains, MeanWaveform, NearestRecording, WhiteNoise, floor
from avmsf.evaluation.task import Renderer
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction

HEADINGS = {
    "relative_stft": "relative STFT error",
    "l1": "L1",
    "l1_log": "L1-log",
    "envelope": "ENV",
}
"""Metrics in the order of the table, as its columns call them."""


def compare(field: SoundField, train: Impacts, test: Impacts, modes: Extraction) -> dict[str, Scores]:
    """Score the field, baselines of the same training impacts, and the held-out recordings' own gains without noise.

    All by recordings aligned like those that the modes were found in.
    """
    train, test, count = modes.aligned(train), modes.aligned(test), min(3, len(train))
    renderers: dict[str, Renderer] = {
        "field": field,
        "nearest recording": NearestRecording(train),
        f"mean waveform of {count} nearest": MeanWaveform(train, count),
    }
    if train.directions is not None:
        renderers[f"mean waveform of {count} nearest, by direction"] = MeanWaveform(train, count, by_direction=True)
    renderers |= {f"mean gains of {count} nearest": MeanGains(train, modes, count), "white noise": WhiteNoise(train)}
    scores = {name: evaluate(renderer, test) for name, renderer in renderers.items()}
    return scores | {"the held-out recordings' own gains, no noise": score(floor(test, modes.bank), test)}


def parts_words(train: Impacts, test: Impacts) -> str:
    """Return how many positions are held out and how many are trained on, with the recordings where these are more."""
    owners = places_of(torch.cat([train.contacts, test.contacts]).double()).tolist()
    recorded, left = len(set(owners[: len(train)])), len(set(owners[len(train) :]))
    repeats = (
        "" if (recorded, left) == (len(train), len(test)) else f" ({len(test)} and {counted(len(train), 'recording')})"
    )
    return f"{counted(left, 'position')} not trained on, {recorded} trained on{repeats}"


def quality_words(field: SoundField, path: Path) -> list[str]:
    """Return the quality of a field in the file `path`, and the command for more contacts; empty if unknown."""
    if isinstance(guess := field.origin.report.get("guess"), str):
        return [f"{guess} Record a few impacts and fit again: avmsf fit"]
    if field.quality is None:
        return []
    more = f" More contacts: avmsf suggest {shlex.quote(str(path))}" if field.quality.advice else ""
    return [f"{field.quality}{more}"]


def body_warnings(field: SoundField) -> list[str]:
    """Return the warning of a field's most probable body; empty where there is none."""
    return [f"warning: {field.body.warning}"] if field.body is not None and field.body.warning else []


def advice_on_labels(field: SoundField) -> list[str]:
    """Return in which other order or levels the recordings agree with the contacts; empty where in none."""
    return [field.origin.report["advice"]] if field.origin.report.get("advice") else []


def outlier_words(field: SoundField) -> list[str]:
    """Return a line for each recording that contradicts the others: what was done, why it may be; --verbose figures."""
    report = field.origin.report
    lines = []
    for name, words in report.get("outliers", {}).items():
        done = "left out of the fit" if name in report.get("excluded", ()) else "used in the fit all the same"
        found = report.get("outlier_figures", {}).get(name)
        lines.append(f"{done}: {words}" + (f" ({_figures(found)})" if verbosity.verbose and found else ""))
    return lines


def _figures(found: Mapping[str, Any]) -> str:
    where = ", ".join(f"{each + 0.0:.4g}" for each in found["place"])
    return (
        f"log likelihood ratio per mode {found['ratio']:.2g}, and {found['place_ratio']:.2g} at ({where}) m, "
        f"{found['distance']:.2g} m away; plausible above 0"
    )


def score_table(title: str, scores: Mapping[str, Scores]) -> Table:
    """Return the means for printing, with the standard error of the first metric."""
    rows = []
    for method, each in scores.items():
        mean, error = each.mean(), each.standard_error()
        first, *others = HEADINGS
        rows.append(
            [
                method,
                f"{format_number(mean[first])} ± {format_number(error[first], 1)}",
                *(format_number(mean[metric]) for metric in others),
            ]
        )
    return table(title, ["", *HEADINGS.values()], rows)


def score_values(scores: Mapping[str, Scores]) -> dict[str, dict[str, float]]:
    """Return the means as plain values for JSON."""
    return {method: each.mean() for method, each in scores.items()}
