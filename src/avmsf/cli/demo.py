"""`avmsf demo`: all the way on a plate whose sounds are known in closed form."""

import shutil
import uuid
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from avmsf.bench.baselines import MeanWaveform
from avmsf.bench.evaluation import Scores, split
from avmsf.bench.pictures import draw_gains, draw_modes, draw_scores, draw_spectrograms, save_picture
from avmsf.capture import Capture, Impacts, Surface, check, read_capture, write_capture
from avmsf.cli.modes import mode_table
from avmsf.cli.modetable import amplitudes, levels, mode_rows
from avmsf.cli.printing import console, json_text, say
from avmsf.cli.progress import FitBar
from avmsf.cli.scores import compare, score_markdown, score_table, score_values
from avmsf.cli.writing import Level, OutputError, write_sound, write_text
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.soundfield import SoundField
from avmsf.field.store import load, save
from avmsf.modal.extract import extract
from avmsf.modal.extraction import Extraction
from avmsf.scene.features import FeatureField
from avmsf.scene.points import farthest_points
from avmsf.simulate.plate import Plate, plate_surface_points, sample_contacts, strike

PLATE = Plate(thickness=0.004)
CONTACTS, TRAIN = 40, 16
SECONDS, SAMPLE_RATE, NOISE_DB = 1.0, 44100.0, -40.0
CONTACT_TIME = 5e-4
"""How long the hammer's tip stays on the plate, s: a hard rubber one."""
MARK = "demo.json"
"""File by which a folder is known to be a demo's own, and may be replaced."""
_HEARD = 3
"""Contacts whose sounds are written."""


@dataclass(frozen=True)
class Options:
    """Go all the way on a built-in example: capture, modes, field, sounds, pictures, figures.

    A steel plate of 24 x 17 cm is struck with a rubber hammer at 40 places, in closed form and with noise 40 dB down.
    A field is fitted to 16 of the blows and judged by the others.
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
    _record(folder / "capture")
    report = check(folder / "capture")
    wrong = sum(bool(each.problems) for each in report.recordings)
    say(f"check: {len(report.recordings)} recordings, {wrong} to look at")
    capture = read_capture(folder / "capture")
    train, test = split(capture.impacts, count=TRAIN)
    say(f"modes: from {len(train)} recordings of {train.duration:.3g} s")
    modes = extract(train)
    level = levels(amplitudes(modes))
    screen.print(mode_table(f"{len(level)} modes of {capture.name}", mode_rows(modes.bank, level)))
    field = _fit(capture, train, modes)
    save(field, folder / "plate.safetensors")
    field = load(folder / "plate.safetensors")
    scores = compare(field, train, test, modes)
    title = f"{len(test)} contacts not trained on, {len(train)} trained on; lower is better"
    screen.print(score_table(title, scores))
    heard = test.take(farthest_points(test.contacts, _HEARD).tolist())
    _write_sounds(folder / "sounds", field, train, heard)
    _draw(folder / "pictures", field, modes, train, heard, scores)
    write_text(folder / "scores.md", f"{title}\n\n{score_markdown(scores)}")
    facts = {"contacts": CONTACTS, "train": list(train.names), "test": list(test.names), "plate": asdict(PLATE)}
    write_text(folder / MARK, json_text(facts | {"scores": score_values(scores)}) + "\n")
    write_text(folder / "LISTEN.txt", _guide("", len(heard)))
    return _guide(f"{folder}/", len(heard))


def _record(folder: Path) -> None:
    """Write the plate's blows as an ordinary capture folder, with its rectangle as the surface."""
    generator = torch.Generator().manual_seed(0)
    contacts = sample_contacts(PLATE, CONTACTS, generator=generator)
    impacts = strike(
        PLATE,
        contacts,
        sample_rate=SAMPLE_RATE,
        seconds=SECONDS,
        generator=generator,
        noise_db=NOISE_DB,
        contact_time=CONTACT_TIME,
    )
    a, b = PLATE.length, PLATE.width
    corners = torch.tensor([[0.0, 0.0, 0.0], [a, 0.0, 0.0], [a, b, 0.0], [0.0, b, 0.0]])
    surface = Surface(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    write_capture(Capture("plate", impacts, surface), folder)


def _fit(capture: Capture, train: Impacts, modes: Extraction) -> SoundField:
    assert capture.surface is not None
    features = FeatureField.from_mesh(capture.surface, generator=torch.Generator().manual_seed(0))
    # A plate's dampings are the same everywhere, so that the trials which would find this out can be left out.
    config = FitConfig(damping="shared")
    with FitBar() as bar:
        return fit(train, features, modes, config, capture=capture.name, progress=bar.show)


def _write_sounds(folder: Path, field: SoundField, train: Impacts, heard: Impacts) -> None:
    """Write recorded, rendered and averaged sounds on one scale, and a walk across the plate."""
    rendered = field.render(heard.contacts)
    averaged = MeanWaveform(train).render(heard.contacts)
    factor = Level("peak", -1.0).factor(torch.cat([heard.sounds, rendered, averaged]))
    for row in range(len(heard)):
        for kind, sounds in (("1-recorded", heard.sounds), ("2-field", rendered), ("3-mean-of-nearest", averaged)):
            path = folder / f"contact-{row + 1}-{kind}.wav"
            write_sound(path, factor * sounds[row], sample_rate=field.sample_rate, coding="float32")
    walk = _walk(field)
    walk = walk * Level("peak", -1.0).factor(walk[None])
    write_sound(folder / "walk.wav", walk, sample_rate=field.sample_rate, coding="float32")


def _walk(field: SoundField, *, steps: int = 24, every: float = 0.22) -> Float[Tensor, " samples"]:
    """Return blows along the diagonal from near a corner to the middle and on, each let ring."""
    part = torch.linspace(0.06, 0.94, steps, dtype=torch.float64)[:, None]
    places = part * torch.tensor([[PLATE.length, PLATE.width, 0.0]], dtype=torch.float64)
    sounds = field.render(places)
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
    points = plate_surface_points(PLATE, 3000)
    pictures = {
        "modes": draw_modes(modes.bank, levels(amplitudes(modes)), title=f"{len(modes.bank)} modes of the plate"),
        "gains": draw_gains(
            points,
            field.gains(points),
            field.bank.frequency,
            contacts=train.contacts,
            title="gains of the strongest modes as fitted; crosses: training contacts",
        ),
        "spectrograms": draw_spectrograms(
            heard.sounds,
            field.render(heard.contacts),
            sample_rate=field.sample_rate,
            names=[f"contact {row + 1}" for row in range(len(heard))],
            title="contacts that the field has never heard",
        ),
        "scores": draw_scores(scores, title="how far rendered sounds are from recorded ones"),
    }
    for stem, picture in pictures.items():
        save_picture(picture, folder / f"{stem}.png")


def _guide(prefix: str, heard: int) -> str:
    """Say what to listen to; `prefix` goes before the files' names."""
    return f"""
Listen to {prefix}sounds/walk.wav: blows along the plate's diagonal, at places that were never struck.
Then, for each of {heard} contacts that the field has never heard, in this order:
  contact-1-1-recorded.wav         what was recorded there
  contact-1-2-field.wav            what the field makes of it
  contact-1-3-mean-of-nearest.wav  the mean of the three nearest recordings

Look at {prefix}pictures: scores.png, spectrograms.png, gains.png, modes.png.
{prefix}scores.md and {prefix}{MARK} hold the figures.
{prefix}capture is a folder as one fills it by hand, {prefix}plate.safetensors the field that was fitted to it.
Strike the plate yourself, anywhere from 0 0 0 to {PLATE.length:.3g} {PLATE.width:.3g} 0 metres:
  avmsf render {prefix}plate.safetensors --at 0.1 0.05 0 --output mine.wav
"""
