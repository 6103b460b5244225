"""`avmsf demo`: a complete example, from photographs and recordings of a mug to its sound anywhere, with its errors."""

import json
import shlex
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from avmsf._utils.files import copy_whole, way_out
from avmsf.capture import Impacts, check, read_capture
from avmsf.cli.mode_table import amplitudes, levels
from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.demo import STAGES, Options
from avmsf.cli.printing import console, figure, json_text, print_json, print_text, say
from avmsf.cli.progress import ProgressBar
from avmsf.cli.scores import compare, parts_words, score_markdown, score_table, score_values
from avmsf.cli.writing import Level, write_sound, write_text
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import Scores, split
from avmsf.export.web import write_webpage
from avmsf.field.config import FitConfig
from avmsf.field.scaled_gains import surface_of
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.points import farthest_points
from avmsf.pipeline.config import DESCRIPTORS, LiftConfig, PipelineConfig, SceneConfig
from avmsf.pipeline.fit import fit_in_stages
from avmsf.pipeline.record import modes_words
from avmsf.pipeline.scene import CLOUD, ProgressListener
from avmsf.pipeline.stages import StageFolder
from avmsf.plotting.pictures import draw_modes, draw_scores, save_picture
from avmsf.plotting.spectrograms import draw_spectrograms
from avmsf.simulate.recipe import EXAMPLE, EXAMPLE_FOLDER

TRAIN = 12
"""Impacts that the field is fitted to; it is evaluated at the others."""
CONFIG = PipelineConfig(
    # With four times as many steps, the field's error is the same within the variation of runs (.328; .321 to .350 with
    # these). The built-in descriptors need no download.
    scene=SceneConfig(splat=SplatConfig(steps=500), lift=LiftConfig(encoder=DESCRIPTORS)),
    # A mug's dampings hardly change with position, so the trials that would find this are left out.
    fit=FitConfig(damping="shared"),
)
FIELD, GAUSSIANS, SHAPE, PAGE = "mug.safetensors", "mug.ply", "mug-surface.ply", "mug.html"
SCORES, RECORD = "scores.md", "demo.json"
_MAX_SOUNDS = 2
"""Contacts whose sounds and spectrograms are written."""


def run(options: Options) -> int:
    """Fill the folder, then print a summary."""
    try:
        with ProgressBar() as bar:
            scores, strikes, report = _go_all_the_way(options.folder, bar.listener)
    except OSError as error:
        path, reason = error.filename or options.folder, error.strerror or str(error)
        raise OutputError.expected("a writable path", reason, file=path, advice=way_out(error)) from error
    screen = console(errors=options.json)
    screen.print(score_table(_title(*strikes), scores))
    words = closing_words(options.folder, scores, *strikes, report)
    if options.json:
        say(words)
        print_json({"output": str(options.folder), **json.loads((options.folder / RECORD).read_text("utf-8"))})
    else:
        print_text(words)
    return 0


def _go_all_the_way(
    folder: Path, listener: ProgressListener
) -> tuple[dict[str, Scores], tuple[Impacts, Impacts], Mapping[str, Any]]:
    """Fill `folder`; return the scores, the impacts fitted to and scored on, and the field's report."""
    if not (folder / "capture").is_dir():
        begun = folder / STAGES / "capture"
        shutil.copytree(EXAMPLE_FOLDER, begun, dirs_exist_ok=True)
        begun.rename(folder / "capture")
    report = check(folder / "capture")
    wrong = sum(bool(each.problems) for each in report.recordings)
    listener.log(f"check: {len(report.recordings)} recordings, {wrong} with problems")
    capture = replace(read_capture(folder / "capture"), name="mug")
    train, test = split(capture.impacts, TRAIN)
    made = fit_in_stages(capture, CONFIG, StageFolder(folder / STAGES), train=train, listener=listener)
    train, test = made.modes.aligned(train), made.modes.aligned(test)
    listener.log("page: a web page, sounds, figures and scores")
    copy_whole(made.field, folder / FIELD)
    copy_whole(folder / STAGES / CLOUD, folder / GAUSSIANS)
    field = load(folder / FIELD)
    scores = compare(field, train, test, made.modes)
    held_out = test.take(farthest_points(test.contacts, min(_MAX_SOUNDS, len(test))).tolist())
    surface = surface_of(field.gain_field) or made.surface
    write_webpage(field, folder / PAGE, object=folder / GAUSSIANS, surface=surface, strikes=test, force=True)
    if made.surface is not None:
        copy_whole(made.surface, folder / SHAPE)
    _write_sounds(folder / "sounds", field, train, held_out)
    poles = modes_words(len(field.bank), int((~field.is_mode).sum()))
    pictures = {
        "modes": draw_modes(
            made.modes.bank, levels(amplitudes(made.modes)), is_mode=field.is_mode, title=f"{poles} of the mug"
        ),
        "spectrograms": draw_spectrograms(
            held_out.sounds,
            field.render(held_out.contacts, directions=held_out.directions),
            sample_rate=field.sample_rate,
            names=[f"impact {row + 1}" for row in range(len(held_out))],
            title="held-out impacts",
        ),
        "scores": draw_scores(
            {method: each.mean()["relative_stft"] for method, each in scores.items()},
            {method: each.standard_error()["relative_stft"] for method, each in scores.items()},
            title="errors of rendered sounds",
        ),
    }
    for stem, picture in pictures.items():
        save_picture(picture, folder / "pictures" / f"{stem}.png")
    write_text(folder / SCORES, f"{_title(train, test)}\n\n{score_markdown(scores)}")
    facts = {
        "train": list(train.names),
        "test": list(test.names),
        "report": field.origin.report,
        "true_wall": EXAMPLE.thickness,
        "stages": {each.stage: each.seconds for each in made.stages},
        "scores": score_values(scores),
    }
    write_text(folder / RECORD, json_text(facts) + "\n")
    return scores, (train, test), field.origin.report


def _title(train: Impacts, test: Impacts) -> str:
    return f"{parts_words(train, test)}; lower is better; L1-log counts noise, which the last row lacks"


def _write_sounds(folder: Path, field: SoundField, train: Impacts, held_out: Impacts) -> None:
    """Write recorded, rendered and averaged sounds on one scale."""
    rendered = field.render(held_out.contacts, directions=held_out.directions)
    averaged = MeanWaveform(train).render(held_out.contacts)
    factor = Level("peak", -1.0).factor(torch.cat([held_out.sounds, rendered, averaged]))
    for row in range(len(held_out)):
        for kind, sounds in (("1-recorded", held_out.sounds), ("2-model", rendered), ("3-mean-of-nearest", averaged)):
            path = folder / f"impact-{row + 1}-{kind}.wav"
            write_sound(path, factor * sounds[row], sample_rate=field.sample_rate, coding="float32")


def verdict(scores: Mapping[str, Scores], test: int) -> str:
    """Return the errors of the field and of the nearest recordings as text, and which is lowest."""
    mean = next(name for name in scores if name.startswith("mean waveform"))
    names = {
        "field": "the model",
        "nearest recording": "the nearest recording",
        mean: "the mean of the three nearest recordings",
    }
    errors = {words: scores[name].mean()["relative_stft"] for name, words in names.items()}
    said = ", ".join(f"{words} has {figure(error, 2)}" for words, error in errors.items())
    best = min(errors, key=lambda words: errors[words])
    return (
        f"The relative STFT error at {test} held-out positions:\n{said}.\n"
        "(0: the same sound, 1: the error of silence.)\n"
        f"The lowest error has {best}."
    )


def wall_words(report: Mapping[str, Any]) -> str:
    """Return the wall thickness of a field's report, and the true one; empty where it has none."""
    found = report.get("thickness")
    if found is None or EXAMPLE.thickness is None:
        return ""
    median, low, high = (f"{1000 * found[name]:.2g}" for name in ("median", "low", "high"))
    return (
        f"\nThe photographs do not show the mug's wall thickness. By the recordings it is {median} mm (90 % interval: "
        f"{low} to\n{high} mm); in the simulation it is {1000 * EXAMPLE.thickness:.2g} mm."
    )


def closing_words(
    folder: Path, scores: Mapping[str, Scores], train: Impacts, test: Impacts, report: Mapping[str, Any]
) -> str:
    """Return the introduction to a finished demo in `folder`; `report` is the field's."""
    x, y, z = test.contacts[0].tolist()
    command, place, shape = _command(), shlex.quote(str(folder)), folder / SHAPE
    surface = f"  {shape}: the mug's surface, reconstructed from the photographs\n" if shape.is_file() else ""
    return f"""
From photographs of a mug and recordings of {len(train)} impacts, avmsf fitted a model of its sound. The model predicts
the sound of an impact anywhere on the mug. The mug is simulated: its photographs and its recordings, with noise, come
from avmsf's simulator. The model did not use the simulated mesh; the mug's shape is reconstructed from the
photographs.{wall_words(report)}

{verdict(scores, len(test))}

Open {folder / PAGE} in a browser and click the mug to strike it.
  {folder / "sounds"}: impacts as recorded, by the model, and as the mean of the nearest recordings
  {folder / "pictures" / "spectrograms.png"}: their spectrograms; {folder / SCORES}: all errors
{surface}  {folder / "capture"}: the input; record your own object in the same way

Next, try:
  {command} render {place}/{FIELD} --position {x:.3f} {y:.3f} {z:.3f} -o impact.wav   # an impact anywhere, in meters
  {command} locate {place}/{FIELD} {place}/capture/{test.names[0]}   # the contact of a recording
  {command} fit YOUR_FOLDER --output yours.safetensors   # your own object"""


def _command() -> str:
    """Return the command of this program: its path where the shell does not find it."""
    return "avmsf" if shutil.which("avmsf") or Path(sys.argv[0]).name != "avmsf" else shlex.quote(sys.argv[0])
