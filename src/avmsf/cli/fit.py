"""`avmsf fit`: a capture folder in, a field file out, or what a stage before it makes."""

import shlex
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import trimesh
from rich.console import Console

from avmsf._utils.device import TRAINABLE, usable_device
from avmsf._utils.files import copy_whole, write_whole
from avmsf._utils.text import counted, format_number
from avmsf.capture import Capture, CaptureSettings, Impacts, read_capture
from avmsf.capture.checks import check_one_unit, find_surface
from avmsf.capture.settings import TABLE
from avmsf.capture.table import in_folder, parse_row, read_rows
from avmsf.cli import INTERRUPTED
from avmsf.cli.alignment import describe_alignment
from avmsf.cli.heartbeat import doing
from avmsf.cli.options.checks import OutputError, read_settings
from avmsf.cli.options.fit import Options
from avmsf.cli.printing import console, next_command, next_step, print_json, print_result, say, table
from avmsf.cli.progress import ProgressBar
from avmsf.cli.scores import (
    advice_on_labels,
    body_warnings,
    compare,
    outlier_words,
    parts_words,
    quality_words,
    score_table,
    score_values,
)
from avmsf.errors import FitError
from avmsf.evaluation.scores import Scores
from avmsf.evaluation.splits import split
from avmsf.features.store import load_features, read_report
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.surface import Surface, SurfaceKind, read_surface, write_surface
from avmsf.pipeline.fit import StagedFit, fit_in_stages, guess_in_stages
from avmsf.pipeline.record import capture_settings_of, modes_words
from avmsf.pipeline.scene import SceneStages
from avmsf.pipeline.shape import keep_surface, object_shape
from avmsf.pipeline.stages import Kept, StageFolder
from avmsf.pipeline.visuals import expect_shape
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.surfaces import draw_surface
from avmsf.symmetry.symmetries import Symmetries

_SHOWN = 8
"""Names of recordings in a line, at most."""


def run(options: Options) -> int:
    """Fit, write, and print a summary; return 130 where Ctrl-C stopped it."""
    usable_device(options.device, raising=FitError, kinds=TRAINABLE)
    settings = capture_settings_of(options.all_settings, read_settings(options.capture, options.settings))
    try:
        if options.until is not None:
            _make_stage(options, settings)
        elif options.material is not None:
            _guess(options, options.material, settings)
        else:
            _fit(options, settings)
    except KeyboardInterrupt:
        say("avmsf fit: interrupted; repeat the command to continue")
        return INTERRUPTED
    return 0


def _fit(options: Options, settings: CaptureSettings) -> None:
    capture = read_capture(options.capture, settings)
    if options.without_shape:
        capture = replace(capture, surface=None, folder=None)
    elif options.features is None:
        expect_shape(capture)
    train, test = _parts(capture, options)
    features, described = None, None
    if options.features is not None:
        features, described = load_features(options.features), read_report(options.features)
    stages = StageFolder(options.kept)
    with ProgressBar() as bar, stages.lock("avmsf fit"):
        made = fit_in_stages(
            capture,
            options.all_settings,
            stages,
            train=train,
            features=features,
            features_report=described,
            listener=bar.listener,
        )
        fitted = load(made.field)
        if options.output is not None:
            copy_whole(made.field, options.output)
    screen, path = console(errors=options.json), options.output or made.field
    for sentence in (*advice_on_labels(fitted), *describe_alignment(made.modes, train)):
        screen.print(sentence, soft_wrap=True)
    doing("comparing the field with the recordings that it was not fitted to")
    scores = {} if test is None else compare(fitted, train, test, made.modes)
    if test is not None:
        shown = ", ".join(test.names[:_SHOWN]) + f" and {len(test) - _SHOWN} more" * (len(test) > _SHOWN)
        say(f"not trained on: {shown}")
    if made.report:
        screen.print(features_words(made.report), soft_wrap=True)
    rows = [[each.stage, format_number(each.seconds), "computed" if each.fresh else "cached"] for each in made.stages]
    screen.print(table("stages", ["stage", "seconds", "source"], rows))
    print_fitted(screen, fitted, train, test, scores, path)
    if made.surface is not None:
        screen.print(f"the object's surface is {made.surface}", soft_wrap=True)
    screen.print(f"wrote {path}", soft_wrap=True)
    if test is not None:
        next_step(
            "the same command without --train-fraction and --train-count, and another --output, fits all recordings"
        )
    else:
        next_command("avmsf render", path, "--position X Y Z -o impact.wav")
    if fitted.quality is not None and fitted.quality.level > 0:
        # Last, so that it is read: the field is not better than averaging recordings.
        say(str(fitted.quality))
    if options.json:
        print_json(_values(options, path, fitted, made) | _split_values(train, test, scores))


def _values(options: Options, path: Path, fitted: SoundField, made: StagedFit) -> dict[str, Any]:
    """Return what a fit made, as plain values."""
    return {
        "field": str(path),
        "capture": fitted.origin.capture,
        "modes": int(fitted.is_mode.sum()),
        "supporting_poles": int((~fitted.is_mode).sum()),
        "report": fitted.origin.report,
        "body": None if fitted.body is None else fitted.body.record(),
        "quality": None if fitted.quality is None else fitted.quality.level,
        "surface": None if made.surface is None else str(made.surface),
        "preset": options.preset,
        "config": asdict(options.all_settings.fit),
        "features_report": made.report,
        "stages": [asdict(each) for each in made.stages],
        "sample_rate": fitted.sample_rate,
    }


def _split_values(train: Impacts, test: Impacts | None, scores: Mapping[str, Scores]) -> dict[str, Any]:
    names = {"trained_on": list(train.names), "tested_on": [] if test is None else list(test.names)}
    return {**names, "scores": score_values(scores)}


def _parts(capture: Capture, options: Options) -> tuple[Impacts, Impacts | None]:
    """Return the recordings to fit to and those to score on, None where all are fitted to."""
    size = options.train_count if options.train_fraction is None else options.train_fraction
    return (capture.impacts, None) if size is None else split(capture.impacts, size, start=options.start)


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


def _guess(options: Options, material: str, settings: CaptureSettings) -> None:
    """Compute a field without recordings, and print a summary."""
    stages = StageFolder(options.kept)
    with ProgressBar() as bar, stages.lock("avmsf fit"):
        made = guess_in_stages(
            options.capture, material, options.all_settings, stages, settings=settings, listener=bar.listener
        )
        guessed, path = load(made), options.output or made
        if options.output is not None:
            copy_whole(made, options.output)
    screen = console(errors=options.json)
    for words in quality_words(guessed, path):
        screen.print(words, soft_wrap=True)
    screen.print(f"wrote {path}", soft_wrap=True)
    next_command("avmsf render", path, "--position X Y Z -o impact.wav")
    if options.json:
        values = {"field": str(path), "capture": guessed.origin.capture, "modes": len(guessed.bank)}
        values |= {"sample_rate": guessed.sample_rate, "trained_on": [], "report": guessed.origin.report}
        print_json(values)


def _make_stage(options: Options, settings: CaptureSettings) -> None:
    """Make Gaussians, features or a surface of the folder's views, and print what they are."""
    check_one_unit(options.capture, settings)
    stages = StageFolder(options.kept)
    with ProgressBar() as bar:
        scene = SceneStages(
            options.capture,
            stages,
            options.all_settings.scene,
            settings=settings,
            listener=bar.listener,
            device=options.device,
        )
        scene.expect_any()
        with stages.lock("avmsf fit"):
            match options.until:
                case "gaussians":
                    made, key, values = scene.cloud, "cloud", {"gaussians": len(read_splats(scene.cloud.path))}
                    words = counted(values["gaussians"], "Gaussian")
                case "features":
                    made, key, values = scene.features, "features", read_report(scene.features.path)
                    words = features_words(values)
                case _:
                    made = keep_surface(stages, *object_shape(find_surface(options.capture, settings), scene))
                    surface = read_surface(made.path)
                    key, values, words = "surface", {"triangles": len(surface.faces)}, surface_words(surface)
                    if options.plots is not None:
                        _draw(surface, options.capture, settings, options.plots / "surface.png")
            if options.output is not None:
                _write_stage(made.path, options.output)
    lines = [words, *(stage_line(name, each) for name, each in {**scene.made(), key: made}.items())]
    if options.plots is not None:
        lines.append(f"wrote {options.plots / 'surface.png'}")
    if options.output is not None:
        lines.append(f"wrote {options.output}")
    path = options.output or made.path
    print_result("\n".join(lines), {key: str(path), **values}, json=options.json)
    match options.until:
        case "gaussians":
            next_command("avmsf info", path, "--plots plots")
        case "features":
            model = "--preset paper" if options.preset == "paper" else "--gain-model visual"
            words = f"--features {shlex.quote(str(path))} {model} -o field.safetensors"
            next_command("avmsf fit", options.capture, words)
        case _:
            next_command("avmsf fit", options.capture, "-o field.safetensors")


def _write_stage(made: Path, output: Path) -> None:
    """Copy what a stage made; a surface is written in the format of the output."""
    suffix = output.suffix.lower()
    if suffix == ".obj" or suffix == ".glb":
        kind: SurfaceKind = "obj" if suffix == ".obj" else "glb"
        surface = read_surface(made)
        write_whole(output, lambda place: write_surface(surface, place, kind=kind), raising=OutputError)
    else:
        copy_whole(made, output)


def _draw(surface: Surface, folder: Path, settings: CaptureSettings, picture: Path) -> None:
    """Draw a surface with the contacts of the folder's table. Raises CaptureError for a bad table."""
    contacts = None
    if (folder / TABLE).is_file():
        with in_folder(folder):
            rows = [parse_row(row, settings).contact for row in read_rows(folder)[0]]
        contacts = torch.tensor(rows, dtype=torch.float64)
    save_picture(draw_surface(surface, title=f"{folder.resolve().name}: surface", contacts=contacts), picture)


def surface_words(surface: Surface) -> str:
    """Return a message on a surface's size, and on whether it is closed."""
    mesh = trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=True)
    extent = " x ".join(f"{1000 * side:.3g}" for side in mesh.extents)
    words = f"{counted(len(surface.faces), 'triangle')}, {extent} mm, area {1e4 * mesh.area:.3g} cm2"
    closed = f"closed, volume {1e6 * mesh.volume:.3g} cm3" if mesh.is_watertight else "not closed"
    return f"{words}, {closed}"


def stage_line(name: str, kept: Kept) -> str:
    """Return a message on a stage's time and output."""
    return f"{name:9} {kept.seconds:7.1f} s{'' if kept.fresh else ' (cached)'}  {kept.path}"


def features_words(report: Mapping[str, Any]) -> str:
    """Return a message on the features, their consistency over the views, and their symmetries."""
    lines = [
        f"features: {report['encoder']}, on {report['points']} points, {report['unseen']} of them in no view; "
        f"consistency of the views {100 * report['agreement']:.0f} % of the features' variance"
    ]
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
    return "\n".join(lines)


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
