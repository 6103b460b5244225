"""`avmsf demo`: all the way from pictures and taps of a mug to its sound anywhere, beside what is true of it."""

import shutil
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from avmsf.bench.baselines import MeanWaveform
from avmsf.bench.clouds import draw_cloud
from avmsf.bench.evaluation import Scores, split
from avmsf.bench.pictures import draw_gains, draw_modes, draw_scores, draw_spectrograms, save_picture
from avmsf.capture import CaptureSettings, Impacts, check, read_capture
from avmsf.cli.modes import mode_table
from avmsf.cli.modetable import amplitudes, levels, mode_rows
from avmsf.cli.printing import console, json_text, say
from avmsf.cli.progress import FitBar
from avmsf.cli.reconstruct import show_fit
from avmsf.cli.scenebar import SceneBar
from avmsf.cli.scores import compare, score_markdown, score_table, score_values
from avmsf.cli.view_cloud import plain_colors
from avmsf.cli.writing import Level, OutputError, write_sound, write_text
from avmsf.field.config import FitConfig
from avmsf.field.soundfield import SoundField
from avmsf.field.store import load
from avmsf.modal.extract import HighResolution
from avmsf.modal.extraction import Extraction
from avmsf.pipeline.reconstruct import CACHE, ReconstructConfig, Reconstruction, reconstruct
from avmsf.pipeline.scene import CLOUD, SceneConfig
from avmsf.scene.ply import read_splats
from avmsf.scene.points import farthest_points
from avmsf.scene.splatconfig import SplatConfig
from avmsf.simulate.example import EXAMPLE_FOLDER

TRAIN = 12
"""Blows that the field is fitted to; the others judge it."""
CONFIG = ReconstructConfig(
    # A mug's dampings hardly change with place, so that the trials which would find this out can be left out.
    scene=SceneConfig(splat=SplatConfig(steps=1000)),
    fit=FitConfig(damping="shared"),
)
FIELD = "mug.safetensors"
MARK = "demo.json"
"""File by which a folder is known to be a demo's own, and may be replaced."""
_HEARD = 3
"""Contacts whose sounds are written."""


@dataclass(frozen=True)
class Options:
    """Go all the way on a built-in example: images, Gaussians, features, a field, sounds, pictures.

    A ceramic mug, made by `avmsf simulate example`: 48 pictures and 16 blows. Gaussians are fitted to the pictures, a
    field to 12 of the blows, and the other 4 judge it.
    """

    folder: tyro.conf.Positional[Path] = Path("demo")
    """Folder to leave everything in; one that holds an earlier demo is replaced."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return tyro.cli(Options, prog="avmsf demo", args=words)


def run(options: Options) -> int:
    """Make the folder beside its place, then move it there whole."""
    folder = options.folder
    known = (folder / MARK).is_file()
    if folder.exists() and not known and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists and holds no earlier demo; choose another folder or remove it")
    begun = folder.resolve().with_name(f".{folder.resolve().name}.{uuid.uuid4().hex[:8]}")
    try:
        begun.mkdir(parents=True)
        told = _go_all_the_way(begun)
        if folder.exists():
            shutil.rmtree(folder)
        begun.rename(folder.resolve())
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error}") from error
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    print(told.replace(str(begun), str(folder)))
    return 0


def _go_all_the_way(folder: Path) -> str:
    """Fill `folder` and return what to say of it."""
    screen = console(errors=False)
    shutil.copytree(EXAMPLE_FOLDER, folder / "capture")
    report = check(folder / "capture")
    wrong = sum(bool(each.problems) for each in report.recordings)
    say(f"check: {len(report.recordings)} recordings, {wrong} to look at")
    capture = read_capture(folder / "capture")
    train, test = split(capture.impacts, count=TRAIN)
    made = _reconstruct(folder / "capture", train)
    shutil.copyfile(made.field, folder / FIELD)
    field, modes = load(folder / FIELD), made.modes
    level = levels(amplitudes(modes))
    screen.print(mode_table(f"{len(level)} modes of the mug", mode_rows(modes.bank, level)))
    scores = compare(field, train, test, modes)
    title = f"{len(test)} contacts not trained on, {len(train)} trained on; lower is better"
    screen.print(score_table(title, scores))
    heard = test.take(farthest_points(test.contacts, min(_HEARD, len(test))).tolist())
    _write_sounds(folder / "sounds", field, train, heard)
    shutil.move(folder / "capture" / CACHE / CLOUD, folder / "mug.ply")
    _draw(folder, field, modes, train, heard, scores)
    shutil.rmtree(folder / "capture" / CACHE)
    write_text(folder / "scores.md", f"{title}\n\n{score_markdown(scores)}")
    facts = {
        "train": list(train.names),
        "test": list(test.names),
        "gains": made.gains,
        "choice": made.choice,
        "stages": {each.stage: each.seconds for each in made.stages},
    }
    write_text(folder / MARK, json_text(facts | {"scores": score_values(scores)}) + "\n")
    write_text(folder / "LISTEN.txt", _guide("", field, len(heard)))
    return _guide(f"{folder}/", field, len(heard))


def _reconstruct(folder: Path, train: Impacts) -> Reconstruction:
    with SceneBar() as scene_bar, FitBar() as fit_bar:
        return reconstruct(
            folder,
            read_capture(folder),
            train,
            CONFIG,
            method=HighResolution(),
            cache=folder / CACHE,
            settings=CaptureSettings.read(folder / "capture.toml"),
            listener=scene_bar.listener,
            fitting=lambda progress: show_fit(progress, scene_bar, fit_bar),
        )


def _write_sounds(folder: Path, field: SoundField, train: Impacts, heard: Impacts) -> None:
    """Write recorded, rendered and averaged sounds on one scale, and a walk around the mug."""
    rendered = field.render(heard.contacts, directions=heard.directions)
    averaged = MeanWaveform(train).render(heard.contacts)
    factor = Level("peak", -1.0).factor(torch.cat([heard.sounds, rendered, averaged]))
    for row in range(len(heard)):
        for kind, sounds in (("1-recorded", heard.sounds), ("2-field", rendered), ("3-mean-of-nearest", averaged)):
            path = folder / f"contact-{row + 1}-{kind}.wav"
            write_sound(path, factor * sounds[row], sample_rate=field.sample_rate, coding="float32")
    walk = _walk(field, train)
    walk = walk * Level("peak", -1.0).factor(walk[None])
    write_sound(folder / "walk.wav", walk, sample_rate=field.sample_rate, coding="float32")


def _walk(field: SoundField, train: Impacts, *, steps: int = 24, every: float = 0.22) -> Float[Tensor, " samples"]:
    """Return blows around the mug at half its height, each let ring."""
    low, high = train.contacts.amin(0), train.contacts.amax(0)
    angle = 2 * torch.pi * torch.arange(steps, dtype=torch.float64) / steps
    around = torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)], dim=1)
    # The field takes the point of the object that is nearest to each of these.
    sounds = field.render((low + high) / 2 + around * (high - low) / 2)
    hop = round(every * field.sample_rate)
    walk = torch.zeros(hop * (steps - 1) + sounds.shape[1])
    for step, sound in enumerate(sounds):
        walk[step * hop : step * hop + len(sound)] += sound
    return walk


def _draw(
    folder: Path,
    field: SoundField,
    modes: Extraction,
    train: Impacts,
    heard: Impacts,
    scores: dict[str, Scores],
) -> None:
    cloud = read_splats(folder / "mug.ply")
    points = field.gain_field.points
    pictures = {
        "cloud": draw_cloud(
            cloud.centers, {"colour": plain_colors(cloud)}, title=f"{len(cloud)} Gaussians", up=(0.0, 0.0, 1.0)
        ),
        "modes": draw_modes(modes.bank, levels(amplitudes(modes)), title=f"{len(modes.bank)} modes of the mug"),
        "gains": draw_gains(
            points,
            field.gains(points),
            field.bank.frequency,
            contacts=train.contacts,
            title="gains of the strongest modes as fitted; crosses: training contacts",
        ),
        "spectrograms": draw_spectrograms(
            heard.sounds,
            field.render(heard.contacts, directions=heard.directions),
            sample_rate=field.sample_rate,
            names=[f"contact {row + 1}" for row in range(len(heard))],
            title="contacts that the field has never heard",
        ),
        "scores": draw_scores(scores, title="how far rendered sounds are from recorded ones"),
    }
    for stem, picture in pictures.items():
        save_picture(picture, folder / "pictures" / f"{stem}.png")


def _guide(prefix: str, field: SoundField, heard: int) -> str:
    """Say what to listen to; `prefix` goes before the files' names."""
    x, y, z = field.gain_field.points[0].tolist()
    return f"""
Listen to {prefix}sounds/walk.wav: blows around the mug at half its height, most at places that were never struck.
Then, for each of {heard} contacts that the field has never heard, in this order:
  contact-1-1-recorded.wav         what was recorded there
  contact-1-2-field.wav            what the field makes of it
  contact-1-3-mean-of-nearest.wav  the mean of the three nearest recordings

Twelve taps are few for a mug whose modes reach 12 kHz: {prefix}scores.md says how far its field is from what was
recorded at the other four places, and that the mean of the nearest blows is nearer.

Look at {prefix}pictures: cloud.png, scores.png, spectrograms.png, gains.png, modes.png.
{prefix}mug.ply is the mug as Gaussians, for any 3DGS viewer.
{prefix}scores.md and {prefix}{MARK} hold the figures.
{prefix}capture is a folder as one fills it by hand, {prefix}{FIELD} the field that was fitted to it.
Strike the mug yourself, anywhere on it, in metres:
  avmsf render {prefix}{FIELD} --at {x:.3f} {y:.3f} {z:.3f} --output mine.wav
"""
