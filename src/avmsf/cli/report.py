"""What a field is and how good it is, as lines for people and as plain values: for `avmsf fit`, `info` and `modes`."""

import math
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from avmsf._utils.text import counted, format_number
from avmsf.capture import Impacts
from avmsf.capture.impacts import places_of
from avmsf.cli.output import decimals, display, doing, table
from avmsf.evaluation.scores import Scores, evaluate, score
from avmsf.evaluation.simple_methods import MeanGains, MeanWaveform, NearestRecording, WhiteNoise, floor
from avmsf.evaluation.task import Renderer
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.scaled import BodyGains
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.quality import ModeQuality
from avmsf.modal.modes import ModalBank
from avmsf.pipeline.fit import RECORD, modes_words
from avmsf.symmetry.symmetries import Symmetries

MAX_LISTED_MODES = 15
"""Modes in a table, those of most energy."""
_OWN_GAINS = "the held-out recordings' own gains"
HEADINGS = {"relative_stft": "relative STFT error", "l1": "L1", "l1_log": "L1-log", "envelope": "ENV"}
"""Metrics in the order of the table, as its columns call them."""


def describe(field: SoundField) -> dict[str, Any]:
    """Return what the field is, as plain values."""
    points = field.gain_field.points
    return {
        "capture": field.origin.capture,
        "sample_rate": field.sample_rate,
        "seconds": field.samples / field.sample_rate,
        "mode_count": int(field.is_mode.sum()),
        "supporting_pole_count": int((~field.is_mode).sum()),
        "points": len(points),
        "extent_meters": (points.amax(0) - points.amin(0)).tolist(),
        "bounds_meters": [points.amin(0).tolist(), points.amax(0).tolist()],
        "gain_field": {"kind": field.gain_field.kind, **field.gain_field.record()},
        "residual_rms": float(field.residual.magnitude.square().mean().sqrt()),
        "per_newton": field.origin.per_newton,
        "trained_on": list(field.origin.trained_on),
        "pipeline": {**field.origin.report.get(RECORD, {}), "fit": asdict(field.origin.config)},
        "body": None if field.body is None else field.body.record(),
        "report": {name: value for name, value in field.origin.report.items() if name != RECORD},
    }


def field_lines(field: SoundField, path: Path, *, settings: bool = True) -> list[str]:
    """Return lines on a field in the file `path`: what it is and how good it is; all with `settings`."""
    values = describe(field)
    report = values["report"]
    reason = f" ({report['damping_reason']})" if "damping_reason" in report else ""
    modes = modes_words(len(field.bank), values["supporting_pole_count"])
    used = len(values["trained_on"]) - len(report.get("excluded", ()))
    recordings, changes = counted(used, "recording"), report.get("levels")
    if changes:
        low, high = (20.0 * math.log10(each) for each in (min(changes), max(changes)))
        recordings += f", over levels found from their gains, {low:+.1f} to {high:+.1f} dB; quality is at these"
    rows = [
        ("modes", f"{modes}, {report.get('damping', 'shared')} damping{reason}"),
        ("gains", _gains_words(values["gain_field"])),
        ("fitted to", recordings),
    ]
    if settings:
        extent = ", ".join(
            f"{axis} {low:.3g} to {high:.3g}" for axis, low, high in zip("xyz", *values["bounds_meters"], strict=True)
        )
        scale = "per newton" if values["per_newton"] else "on the scale of the recordings"
        rows += [
            ("sounds", f"{values['seconds']:.3g} s at {values['sample_rate']:g} Hz, {scale}"),
            ("noise", f"{values['residual_rms']:.2g} (root mean square of the residual)"),
            ("object", f"{values['points']} points, {extent} m"),
        ]
        made = values["pipeline"]
        if "extraction" in made and "guess" not in report:
            rows.append(("extraction", f"{made['extraction']}, {made['modes']} modes at most"))
            rows.append(("gain model", made["gain_model"]))
    if field.body is not None:
        rows.append(("body", f"{field.body} (the most probable one)"))
        rows += [("warning", field.body.warning)] if field.body.warning else []
        if (evidence := report.get("support_evidence")) and evidence["held"] < evidence["free"]:
            rows.append(("warning", "the recordings fit a free body better than one that is held there: check held"))
    elif report.get("supports_tried"):
        rows.append(("body", "none, free or held, predicts contacts left out better than smooth kernels"))
    if (shift := report.get("frequency_shift")) is not None:
        rows.append(("shifts", f"frequencies differ between recordings by {100 * shift:.2g} %, fitted in each"))
    rows += [("quality", words) for words in quality_words(field, path)]
    for name, words in report.get("outliers", {}).items():
        done = "left out of the fit" if name in report.get("excluded", ()) else "used in the fit all the same"
        rows.append(("outlier", f"{done}: {words}"))
    rows += [("edited", _edit_words(edit)) for edit in report.get("edits", [])]
    if report.get("validated"):
        held = report.get("validation_spectral", {})
        errors = ", ".join(f"{name} {float(error):.3g}" for name, error in held.items())
        rows.append(("chosen on", f"{len(report['validation_contacts'])} validation contacts, spectral error {errors}"))
    name = values["capture"] or "an unnamed capture"
    return [f"field of {name}", *(f"  {title:10} {words}" for title, words in rows)]


def _gains_words(gains: dict[str, Any]) -> str:
    if gains.get("inner", gains["kind"]) == AttentionGains.kind:
        return f"attention network on features: {gains['encoder']}"
    if gains.get("inner", gains["kind"]) == BodyGains.kind:
        return "computed without recordings: mode shapes of a body, each times its level"
    families = ", ".join(dict.fromkeys(gains["families"]))
    return f"Gaussian process over {families} kernels, by {counted(gains['contacts'], 'contact')}"


def _edit_words(edit: Mapping[str, Any]) -> str:
    """Return what an edit is, without settings that change nothing; --json has all."""
    parts = [str(edit.get("edit"))]
    if "from" in edit:
        parts.append(f"from {edit['from']['name']} to {edit['to']['name']}")
    parts += [f"towards {edit[name]!r}" for name in ("prompt", "reference") if name in edit]
    usual = {"size": 1.0, "pitch": 1.0, "decay": 1.0, "brightness_db": 0.0, "gains_db": 0.0}
    for name in [name for name, same in usual.items() if edit.get(name, same) != same]:
        # One value, or one for each mode; None is one that is muted.
        values = edit[name] if isinstance(edit[name], list) else [edit[name]]
        known = [each for each in values if each is not None] or [-math.inf]
        ends = dict.fromkeys(f"{each:.4g}" for each in (min(known), max(known)))
        mute = f", {values.count(None)} muted" if None in values else ""
        parts.append(f"{name} {' to '.join(ends)}{' by mode' * (len(values) > 1)}{mute}")
    parts += [f"{name} {edit[name]}" for name in ("law", "negative", "model", "guidance", "steps") if edit.get(name)]
    beyond = {"silent_hertz": "beyond half the sample rate", "overdamped_hertz": "overdamped"}
    parts += [f"modes {what}: {len(edit[name])}" for name, what in beyond.items() if edit.get(name)]
    if scores := edit.get("clap", {}).get("scores"):
        parts.append(f"CLAP score {scores[0]:.3f} to {scores[-1]:.3f}")
    return ", ".join(parts)


def quality_words(field: SoundField, path: Path) -> list[str]:
    """Return the quality of a field in the file `path`, and the command for more contacts; empty if unknown."""
    if isinstance(guess := field.origin.report.get("guess"), str):
        return [f"{guess} Record a few impacts and fit again: avmsf fit"]
    if field.quality is None:
        return []
    more = f" More contacts: avmsf suggest {shlex.quote(str(path))}" if field.quality.advice else ""
    return [f"{field.quality}{more}"]


def compare(field: SoundField, train: Impacts, test: Impacts, modes: Extraction) -> dict[str, Scores]:
    """Score the field, baselines of the same training impacts, and the held-out recordings' own gains.

    These have the field's noise, unless it has the residuals of recordings in place of noise. All by recordings aligned
    like those that the modes were found in. Directions count in a baseline of their own where they choose other
    neighbors.
    """
    doing("comparing the field with the recordings that it was not fitted to")
    begun = time.monotonic()
    train, test, count = modes.aligned(train), modes.aligned(test), min(3, len(train))
    nearest = f"mean waveform of {count} nearest"
    renderers: dict[str, Renderer] = {
        "field": field,
        "nearest recording": NearestRecording(train),
        nearest: MeanWaveform(train, count),
        f"{nearest}, by direction": MeanWaveform(train, count, by_direction=True),
        f"mean gains of {count} nearest": MeanGains(train, modes, count),
        "white noise": WhiteNoise(train),
    }
    scores = {name: evaluate(renderer, test) for name, renderer in renderers.items()}
    if scores[nearest].mean() == scores[f"{nearest}, by direction"].mean():
        del scores[f"{nearest}, by direction"]
    own = floor(test, modes.bank)
    if field.residual.recordings is None:
        own = own + field.noise(own.shape[1])
    scores |= {_OWN_GAINS: score(own, test)}
    display.listener.ready("scores", time.monotonic() - begun)
    return scores


def parts_words(train: Impacts, test: Impacts) -> str:
    """Return how many positions are held out and how many are trained on, with the recordings where these are more."""
    owners = places_of(torch.cat([train.contacts, test.contacts]).double()).tolist()
    recorded, left = len(set(owners[: len(train)])), len(set(owners[len(train) :]))
    repeats = (
        "" if (recorded, left) == (len(train), len(test)) else f" ({len(test)} and {counted(len(train), 'recording')})"
    )
    return f"{counted(left, 'position')} not trained on, {recorded} trained on{repeats}"


def score_table(title: str, scores: Mapping[str, Scores]) -> str:
    """Return the means for printing, with the standard error of the first metric."""
    rows = []
    for method, each in scores.items():
        mean, error = each.mean(), each.standard_error()
        first, *others = HEADINGS
        with_error = f"{format_number(mean[first])} ± {format_number(error[first], 1)}"
        rows.append([method, with_error, *(format_number(mean[metric]) for metric in others)])
    about = "own gains: measured in the held-out recordings themselves; about the least error that predictions reach"
    return "\n".join([table(title, ["", *HEADINGS.values()], rows), *([about] if _OWN_GAINS in scores else [])])


def features_lines(report: Mapping[str, Any]) -> list[str]:
    """Return lines on the features, their consistency over the views, and their symmetries; none of other reports."""
    if not {"encoder", "points", "unseen", "agreement"} <= report.keys():
        return []
    lines = [
        f"features: {report['encoder']}, on {report['points']} points, {report['unseen']} of them in no view; "
        f"consistency of the views {100 * report['agreement']:.0f} % of the features' variance"
    ]
    if "length" in report:
        length, variation = (format_number(report[name]) for name in ("length", "variation"))
        lines.append(
            f"root mean square of the features' length: {length}; of their distance from their mean: {variation}"
        )
    if report.get("dropped"):
        lines.append(
            f"removed: {counted(report['dropped'], 'Gaussian')} inside the object or behind its surface in the views"
        )
    if "symmetries" in report:
        lines.append(Symmetries.from_dict(report["symmetries"]).summary())
    if "orbit_spread" in report:
        before, after = report["orbit_spread"]
        lines.append(
            f"deviation over symmetric points, relative to all: {before:.3f} before pooling, {after:.3f} after"
        )
    return lines


def levels(amplitudes: Float[Tensor, " modes"]) -> Float[Tensor, " modes"]:
    """Return each mode's amplitude against the strongest pole's, dB; at least -200."""
    loudest = amplitudes.max().clamp_min(torch.finfo(amplitudes.dtype).tiny)
    return 20 * torch.log10((amplitudes / loudest).clamp_min(1e-10))


def mode_rows(
    bank: ModalBank,
    level_db: Float[Tensor, " modes"],
    is_mode: Bool[Tensor, " modes"],
    quality: tuple[ModeQuality, Float64[Tensor, " modes"]] | None = None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the modes and the supporting poles as plain values, numbered together from 1 by frequency.

    `quality` is that of each pole, and the part of the model orders at which it is found.
    """
    columns = {
        "frequency_hertz": bank.frequency,
        "damping_per_second": bank.damping,
        "t60_seconds": bank.t60,
        "level_db": level_db,
    }
    if quality is not None:
        of_poles, stable_orders = quality
        columns |= {
            "frequency_spread_hertz": of_poles.frequency_spread,
            "damping_spread_per_second": of_poles.damping_spread,
            "stable_orders": stable_orders,
            "phase_coherence": of_poles.coherence,
            "energy_share": of_poles.energy_share,
            "explained_left_out": of_poles.explained_left_out,
        }
    cells = zip(*(column.tolist() for column in columns.values()), strict=True)
    rows = [{"number": number, **dict(zip(columns, row, strict=True))} for number, row in enumerate(cells, start=1)]
    parts = list(zip(rows, is_mode.tolist(), strict=True))
    return [row for row, mode in parts if mode], [row for row, mode in parts if not mode]


def mode_table(of: str, rows: Sequence[dict[str, Any]], supporting: int, *, every: bool = False) -> str:
    """Return the modes of most energy, or all, for printing, with their quality where the rows have it."""
    # Energy over time: proportional to the square of the amplitude and to the decay time.
    most = sorted(rows, key=lambda row: row["level_db"] + 10 * math.log10(row["t60_seconds"]), reverse=True)
    most = most if every else most[:MAX_LISTED_MODES]
    which = "sorted by" if len(most) == len(rows) else f"the {MAX_LISTED_MODES} (--all lists all) of most"
    which += " energy: squared amplitude times T60"
    columns = ["mode", "frequency Hz", "damping 1/s", "T60 s", "level dB"]
    scored = any("energy_share" in row for row in rows)
    columns += ["energy", "phase", "orders", "left out"] if scored else []
    cells = []
    for row in most:
        cell = [str(row["number"]), decimals(row["frequency_hertz"], 2), format_number(row["damping_per_second"])]
        cell += [format_number(row["t60_seconds"]), decimals(row["level_db"], 1)]
        if scored:
            cell[1] += f" ± {format_number(row['frequency_spread_hertz'], 2)}"
            cell[2] += f" ± {format_number(row['damping_spread_per_second'], 2)}"
            cell += [f"{100 * row['energy_share']:.2f} %", decimals(row["phase_coherence"], 2)]
            cell += [f"{100 * row['stable_orders']:.0f} %", f"{100 * row['explained_left_out']:.0f} %"]
        cells.append(cell)
    poles = f"\n{counted(supporting, 'supporting pole')} in the model, but not modes (--json lists all)"
    return table(f"{counted(len(rows), 'mode')}{of}, {which}", columns, cells) + (poles if supporting else "")
