"""`avmsf info`: what a field, Gaussians or features hold, as text and pictures."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.text import counted
from avmsf.capture import CaptureSettings, Impacts, read_capture
from avmsf.cli.heartbeat import doing
from avmsf.cli.mode_table import levels, listed, mode_rows, mode_table
from avmsf.cli.options.info import Options
from avmsf.cli.options.paths import kind_of
from avmsf.cli.printing import console, next_command, print_json, say
from avmsf.cli.scores import body_warnings, outlier_words, quality_words, score_table, score_values
from avmsf.evaluation.scores import evaluate
from avmsf.field.config import NETWORK
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.gains.scaled import BodyGains
from avmsf.field.posterior import has_posterior, relative_gain_std, spectrum_band
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.gaussians.points import farthest_points
from avmsf.pipeline.record import RECORD, modes_words, recorded

_DRAWN_POINTS, _LISTED_POINTS = 4000, 500
"""Of the surface: for pictures, and for the mean levels in a table."""
_DRAWN_CONTACTS = 4
_BATCH = 1024
"""Points whose gains are taken at once: the encoding of their offsets to many clusters is large."""


def run(options: Options) -> int:
    """Describe and draw a file, whose kind its content shows."""
    suffix = options.file.suffix.lower()
    if suffix == ".ply" or kind_of(options.file) == "features":
        from avmsf.cli.info_clouds import describe_cloud, describe_features

        values = describe_cloud(options) if suffix == ".ply" else describe_features(options)
        if options.json:
            print_json(values)
        elif options.plots is None:
            next_command("avmsf info", options.file, "--plots plots")
        return 0
    field = load(options.file)
    points = _some(field.gain_field.points, _LISTED_POINTS if options.plots is None else _DRAWN_POINTS)
    gains = gains_at(field, points)
    level = levels(gains)
    every = list(zip(mode_rows(field.bank, level), field.is_mode.tolist(), strict=True))
    rows, supporting = ([row for row, is_mode in every if is_mode is part] for part in (True, False))
    values = describe(field)
    screen = console(errors=options.json)
    screen.print(_words(field, values, quality_words(field, options.file)), soft_wrap=True)
    title, most, rest = listed(", levels on average over the object", rows, len(supporting))
    screen.print(mode_table(title, most))
    if rest:
        screen.print(rest)
    recorded = None
    if options.capture is not None:
        settings = None if options.settings is None else CaptureSettings.read(options.settings)
        doing("comparing the field with the capture's recordings")
        recorded, what = _held_out(read_capture(options.capture, settings).impacts, field)
        recorded = field.aligned(recorded)
        scores = {"field": evaluate(field, recorded)}
        screen.print(score_table(f"{counted(len(recorded), 'contact')}, {what}; lower is better", scores))
        values |= {"compared_with": {"recordings": list(recorded.names), "which": what, "scores": score_values(scores)}}
    if options.plots is not None:
        doing("drawing the figures")
        draw_field(field, options.plots, points=points, gains=gains, level=level, recorded=recorded)
    next_command("avmsf render", options.file, "--position X Y Z -o impact.wav")
    if options.json:
        print_json(values | {"modes": list(map(asdict, rows)), "supporting_poles": list(map(asdict, supporting))})
    return 0


def describe(field: SoundField) -> dict[str, Any]:
    """Return what the field is, as plain values."""
    points = field.gain_field.points
    noise = float(field.residual.magnitude.square().mean().sqrt())
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
        "residual_rms": noise,
        "per_newton": field.origin.per_newton,
        "trained_on": list(field.origin.trained_on),
        "pipeline": {**recorded(field), "fit": asdict(field.origin.config)},
        "body": None if field.body is None else field.body.record(),
        "report": {name: value for name, value in field.origin.report.items() if name != RECORD},
    }


def gains_at(field: SoundField, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points modes"]:
    """Return the gains at many points, without a warning for a point of the field's own that is off its surface."""
    return torch.cat([field.known(part).mean.real for part in torch.split(points, _BATCH)])


def draw_field(
    field: SoundField,
    folder: Path,
    *,
    points: Float[Tensor, "points 3"],
    gains: Float[Tensor, "points modes"],
    level: Float[Tensor, " modes"],
    recorded: Impacts | None,
) -> None:
    """Write the figures of a field, with some of the recordings `recorded` next to its sounds."""
    # Drawing imports matplotlib, which text does without.
    from avmsf.plotting.pictures import draw_gains, draw_modes, save_picture
    from avmsf.plotting.spectrograms import draw_spectrograms
    from avmsf.plotting.surfaces import draw_surface
    from avmsf.plotting.uncertainty import draw_band, draw_uncertainty

    name = field.origin.capture or "field"
    modes = modes_words(len(field.bank), int((~field.is_mode).sum()))
    kept = field.is_mode
    bank = field.bank.take(kept)
    pictures = {
        "modes": draw_modes(field.bank, level, is_mode=field.is_mode, title=f"{modes} of {name}"),
        "gains": draw_gains(points, gains[:, kept], bank, title=f"gains of the modes of most energy of {name}"),
    }
    if recorded is not None:
        chosen = recorded.take(farthest_points(recorded.contacts, min(_DRAWN_CONTACTS, len(recorded))).tolist())
        pictures["spectrograms"] = draw_spectrograms(
            chosen.sounds,
            field.render(chosen.contacts, directions=chosen.directions, samples=chosen.sounds.shape[1]),
            sample_rate=field.sample_rate,
            names=chosen.names,
            title=f"{name}: recorded and rendered",
        )
    if has_posterior(field):
        std, title = relative_gain_std(field, points), f"uncertainty of the gains of {name}"
        pictures["uncertainty"] = draw_uncertainty(points, std, title=title, contacts=field.gain_field.contacts)
        pictures["spectrum"] = draw_band(
            spectrum_band(field, points[0]), title=f"{name}: one impact, with its uncertainty"
        )
    surface = field.gain_field.surface
    if surface is not None:
        pictures["surface"] = draw_surface(surface, title=f"the body of {name}")
    for stem, picture in pictures.items():
        path = folder / f"{stem}.png"
        doing(f"drawing {path}")
        save_picture(picture, path)
        say(f"wrote {path}")


def _some(points: Float[Tensor, "points 3"], most: int) -> Float[Tensor, "chosen 3"]:
    step = max(1, len(points) // most)
    return points[::step]


def _held_out(impacts: Impacts, field: SoundField) -> tuple[Impacts, str]:
    known = set(field.origin.trained_on)
    rows = [row for row, name in enumerate(impacts.names) if name not in known]
    if not rows:
        return impacts, "all of them training recordings"
    return impacts.take(rows), "not training recordings" if len(rows) < len(impacts) else "none a training recording"


def _gains_words(gains: dict[str, Any]) -> str:
    if gains.get("inner", gains["kind"]) == AttentionGains.kind:
        return f"attention network on features: {gains['encoder']}"
    if gains.get("inner", gains["kind"]) == BodyGains.kind:
        return "computed without recordings: mode shapes of a body, each times its level"
    families = ", ".join(dict.fromkeys(gains["families"]))
    return f"Gaussian process over {families} kernels, by {counted(gains['contacts'], 'contact')}"


def _words(field: SoundField, values: dict[str, Any], quality: list[str]) -> str:
    sides = zip("xyz", *values["bounds_meters"], strict=True)
    extent = ", ".join(f"{axis} {low:.3g} to {high:.3g}" for axis, low, high in sides)
    report = values["report"]
    supporting = values["supporting_pole_count"]
    poles = f" and {counted(supporting, 'supporting pole')}" if supporting else ""
    lines = [
        f"field of {values['capture'] or 'an unnamed capture'}",
        f"  sounds     {values['seconds']:.3g} s at {values['sample_rate']:g} Hz, "
        f"{'per newton' if values['per_newton'] else 'on the scale of the recordings'}",
        f"  modes      {values['mode_count']}{poles}, {report.get('damping', 'shared')} damping",
        f"  noise      {values['residual_rms']:.2g} (root mean square of the residual)",
        f"  object     {values['points']} points, {extent} m",
        f"  gains      {_gains_words(values['gain_field'])}",
        f"  fitted to  {counted(len(values['trained_on']), 'recording')}",
    ]
    lines += [] if "guess" in report else _pipeline_lines(values["pipeline"])
    if field.body is not None:
        lines.append(f"  body       {field.body} (the most probable one)")
    lines += [f"  {words}" for words in body_warnings(field)]
    lines += [f"  quality    {words}" for words in quality]
    lines += [f"  {words}" for words in outlier_words(field)]
    for edit in report.get("edits", []):
        lines.append(f"  edited     {_edit_words(edit)}")
    if report.get("validated"):
        held = report.get("validation_spectral", {})
        errors = ", ".join(f"{name} {float(error):.3g}" for name, error in held.items())
        lines.append(f"  chosen on  {len(report['validation_contacts'])} validation contacts, spectral error {errors}")
    return "\n".join(lines)


def _pipeline_lines(pipeline: dict[str, Any]) -> list[str]:
    """Return lines on the stages that made the field, if its file names them."""
    fit, scene = pipeline["fit"], pipeline.get("scene")
    lines = []
    if "extraction" in pipeline:
        lines.append(f"  extraction {pipeline['extraction']}, {pipeline['modes']} modes at most")
        lines.append(f"  gain model {pipeline['gain_model']}")
    if scene is not None:
        lift, count = scene["lift"], scene["views"]["count"]
        lines.append(
            f"  features   {pipeline['encoder']}, {lift['weighting']} mean over {count or 'all'} views, "
            f"{lift['components'] or 'all'} components, onto {lift['onto']}"
        )
    learned = f"{fit['clusters']} clusters, {fit['warmup_steps']} steps of warm-up, "
    network = pipeline.get("gain_model") == NETWORK
    lines.append(
        f"  fit        {learned if network else ''}{counted(fit['steps'], 'step')} end to end, seed {fit['seed']}"
    )
    return lines


def _edit_words(edit: dict[str, Any]) -> str:
    """Return the description of an edit, without settings that change nothing."""
    parts = [str(edit.get("edit"))]
    if "from" in edit:
        parts.append(f"from {edit['from']['name']} to {edit['to']['name']}")
    parts += [f"towards {edit[name]!r}" for name in ("prompt", "reference") if name in edit]
    usual = {"size": 1.0, "pitch": 1.0, "decay": 1.0, "brightness_db": 0.0, "gains_db": 0.0}
    parts += [f"{name} {_by_mode(edit[name])}" for name, same in usual.items() if edit.get(name, same) != same]
    parts += [f"{name} {edit[name]}" for name in ("law", "negative", "model", "guidance", "steps") if edit.get(name)]
    for name, what in (
        ("silent_hertz", "beyond half the sample rate"),
        ("overdamped_hertz", "overdamped"),
    ):
        if edit.get(name):
            parts.append(f"modes {what}: {len(edit[name])}")
    if scores := edit.get("clap", {}).get("scores"):
        parts.append(f"CLAP score {scores[0]:.3f} to {scores[-1]:.3f}")
    return ", ".join(parts)


def _by_mode(values: float | list[float | None] | None) -> str:
    """Return one value, or the range of those of single modes; None is what is muted."""
    if not isinstance(values, list):
        return "-inf" if values is None else f"{values:.4g}"
    low, high = (min(known), max(known)) if (known := [each for each in values if each is not None]) else (0.0, 0.0)
    mute = values.count(None)
    return f"{low:.4g} to {high:.4g} by mode" + (f", {mute} muted" if mute else "")
