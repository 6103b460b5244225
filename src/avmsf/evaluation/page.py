"""A report as one self-contained page: tables, spectrograms, and sounds to play."""

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
import soundfile
import torch
from jaxtyping import Float, Float64, UInt8
from matplotlib import colormaps
from PIL import Image
from scipy.signal import resample_poly
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.evaluation.report_tables import Grid, Section, figure
from avmsf.evaluation.results import CaseRecord, ObjectRecord, Outcome
from avmsf.evaluation.splits import spread
from avmsf.export.web import report_directives, with_policy
from avmsf.plotting.spectrograms import RANGE_DB, log_spectrogram
from avmsf.plotting.style import SEQUENTIAL

_PEAK = 0.25
"""What recordings peak at, of full scale: louder sounds of a method have room above."""
_LEAST_RATE = 8000.0
"""Hz below which browsers do not play."""
_FULL = 1 - 2**-15
_LOWEST = 60.0
"""Hz at the lower edge of pictures, which are logarithmic in frequency above it."""


def listening_gain(recorded: Float[Tensor, " samples"]) -> float:
    """Return the gain of a recording and of the predictions next to it."""
    peak = float(recorded.abs().max())
    return _PEAK / peak if peak > 0 else 1.0


def keep_sound(path: Path, sound: Float[Tensor, " samples"], *, sample_rate: float, gain: float) -> None:
    """Write a sound times `gain` as a FLAC file of 16 bits; what would clip is turned down to full scale.

    Sounds at rates that browsers do not play are resampled by a whole factor. Raises EvaluationError.
    """
    samples = sound.double().numpy() * gain
    factor = max(1, int(np.ceil(_LEAST_RATE / sample_rate)))
    if factor > 1:
        samples = resample_poly(samples, factor, 1)
    peak = float(np.abs(samples).max(initial=0.0))
    if peak > _FULL:
        samples = samples * (_FULL / peak)
    memory = io.BytesIO()
    soundfile.write(memory, samples, round(sample_rate * factor), subtype="PCM_16", format="FLAC")
    write_whole(path, lambda place: place.write_bytes(memory.getvalue()), raising=EvaluationError)


@dataclass(frozen=True, eq=False)
class StoredSound:
    """A kept sound, read back."""

    content: bytes
    """The file as it lies on the disk."""
    samples: Float64[Tensor, " samples"]
    sample_rate: float

    @classmethod
    def read(cls, path: Path) -> "StoredSound":
        """Read a file that `keep_sound` wrote. Raises EvaluationError where it is gone or damaged."""
        try:
            content = path.read_bytes()
            samples, rate = soundfile.read(io.BytesIO(content), dtype="float64")
        except (OSError, soundfile.LibsndfileError) as error:
            raise EvaluationError(
                f"{path}: expected a stored sound, got {error}; delete the object's file to compute it again", file=path
            ) from error
        return cls(content, torch.from_numpy(samples), float(rate))

    @property
    def address(self) -> str:
        """The file as an address that a page plays without any network."""
        return f"data:audio/flac;base64,{base64.b64encode(self.content).decode()}"


def draw_spectrogram(sound: StoredSound, *, loudest: float | None, width: int = 240, height: int = 120) -> str:
    """Return the address of a picture of a sound: time to the right, frequency upwards on a logarithmic scale.

    Colors span 80 dB below `loudest`, the largest magnitude of the recording it is compared with; None is its own.
    """
    levels = _levels(sound, width, height)
    top = float(levels.max()) if loudest is None else loudest
    shown = ((levels - top) / RANGE_DB + 1).clamp(0, 1).flip(0)
    return _png((shown * 255).round().to(torch.uint8).numpy())


def loudest_of(sound: StoredSound, *, width: int = 240, height: int = 120) -> float:
    """Return the level, dB, of the brightest point in a sound's picture."""
    return float(_levels(sound, width, height).max())


def picture_span(sound: StoredSound) -> tuple[float, float, float]:
    """Return a picture's seconds, and its lowest and highest frequency, Hz."""
    highest = sound.sample_rate / 2
    return len(sound.samples) / sound.sample_rate, min(_LOWEST, highest / 50), highest


def _levels(sound: StoredSound, width: int, height: int) -> Float64[Tensor, "height width"]:
    _, lowest, highest = picture_span(sound)
    return log_spectrogram(
        sound.samples, sample_rate=sound.sample_rate, lowest=lowest, highest=highest, width=width, height=height
    )


def _png(shades: UInt8[np.ndarray, "height width"]) -> str:
    picture = Image.fromarray(shades).convert("P")
    colors = (colormaps[SEQUENTIAL](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    picture.putpalette(colors.tobytes())
    memory = io.BytesIO()
    picture.save(memory, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(memory.getvalue()).decode()}"


LARGEST = 13_000_000
"""Maximum number of characters; further contacts are omitted."""
OBJECTS = 4
"""Objects with sounds on the page, evenly spaced over all."""

_STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 84rem; font: 1rem/1.5 system-ui, sans-serif; color: #1c1c1e;
  background: #fff; }
h1, h2, h3 { line-height: 1.2; }
h2 { margin-top: 2.5rem; border-top: 1px solid #ccc; padding-top: 1rem; }
p { max-width: 70ch; }
nav ul { display: flex; flex-wrap: wrap; gap: .2rem 1.2rem; padding: 0; list-style: none; }
a { color: #0b57a4; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
caption { position: absolute; clip-path: inset(50%); width: 1px; height: 1px; overflow: hidden; }
th, td { padding: .3rem .55rem; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th:first-child, td.words { text-align: left; }
td.words { white-space: normal; min-width: 12rem; }
tbody tr:hover { background: #f3f6fa; }
.best { font-weight: 700; }
.sounds { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: 1rem; margin: 0 0 2rem; }
figure { margin: 0; border: 1px solid #ccc; border-radius: .4rem; padding: .5rem; }
figure.recorded { border: 2px solid #0b57a4; }
figure img { width: 100%; height: 8rem; display: block; image-rendering: auto; background: #000; }
figure audio { width: 100%; height: 2.2rem; margin-top: .4rem; display: block; }
figcaption { font-size: .9rem; }
figcaption b { display: block; overflow-wrap: anywhere; }
:focus-visible { outline: 3px solid #e08a00; outline-offset: 2px; }
"""
_SCRIPT = """
document.addEventListener("play", (event) => {
  for (const each of document.querySelectorAll("audio")) if (each !== event.target) each.pause();
}, true);
"""


def page(parts: Sequence[Section], records: Sequence[ObjectRecord], folder: Path) -> str:
    """Return the complete page; sounds are read from the results' folder. Raises EvaluationError for a missing one."""
    title, *others = parts
    blocks = [_section(part, f"part{number}") for number, part in enumerate(others, 1)]
    listening = _listening(records, folder)
    links = [(f"part{number}", part.title) for number, part in enumerate(others, 1)]
    if listening:
        blocks.insert(1, listening)
        links.insert(1, ("listen", "Spectrograms and sounds"))
    entries = "".join(f'<li><a href="#{place}">{escape(words)}</a></li>' for place, words in links)
    opening = "".join(f"<p>{escape(words)}</p>" for words in title.words)
    whole = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title.title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f'<header><h1>{escape(title.title)}</h1>{opening}</header>\n<nav aria-label="Parts of the report">'
        f"<ul>{entries}</ul></nav>\n<main>\n"
        + "\n".join(blocks)
        + f"\n</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )
    return with_policy(whole, report_directives(whole))


def _section(part: Section, place: str) -> str:
    words = "".join(f"<p>{escape(each)}</p>" for each in part.words)
    remarks = "".join(f"<p>{escape(each)}</p>" for each in part.remarks)
    table = "" if part.grid is None else _table(part.grid, part.title)
    return f'<section id="{place}"><h2>{escape(part.title)}</h2>{words}{table}{remarks}</section>'


def _table(grid: Grid, title: str) -> str:
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in grid.columns)
    rows = "".join(
        f'<tr><th scope="row">{escape(first)}</th>'
        + "".join(_cell(cell, best=(number, place) in grid.best) for place, cell in enumerate(cells, 1))
        + "</tr>"
        for number, (first, *cells) in enumerate(grid.rows)
    )
    return (
        f'<div class="wide" tabindex="0" role="region" aria-label="{escape(title)}"><table><caption>{escape(title)}'
        f"</caption><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _cell(words: str, *, best: bool) -> str:
    kind = "best" if best else "words" if any(mark.isalpha() and mark != "e" for mark in words) else ""
    return f'<td class="{kind}">{escape(words)}</td>' if kind else f"<td>{escape(words)}</td>"


@dataclass(frozen=True, eq=False)
class StoredContact:
    """One test contact with stored sounds, and the predictions of all methods."""

    record: ObjectRecord
    name: str
    """The recording's."""
    recorded: str
    """Its file."""
    made: tuple[tuple[CaseRecord, Outcome], ...]


def _contacts(records: Sequence[ObjectRecord]) -> Iterator[StoredContact]:
    """Yield contacts with sounds: one of each object first, then a second one, and so on."""
    stored = [record for record in records if any(case.sounds for case in record.cases)]
    chosen = [list(stored_contacts(stored[row])) for row in spread(len(stored), OBJECTS)]
    for place in range(max(map(len, chosen), default=0)):
        yield from (contacts[place] for contacts in chosen if place < len(contacts))


def stored_contacts(record: ObjectRecord) -> Iterator[StoredContact]:
    """Yield an object's contacts with stored sounds."""
    files = {name: file for case in reversed(record.cases) for name, file in case.sounds.items()}
    for name, file in files.items():
        made = tuple(
            (case, each)
            for case in record.cases
            for each in record.outcomes
            if each.case == case.key and name in each.sounds
        )
        yield StoredContact(record, name, file, made)


def _listening(records: Sequence[ObjectRecord], folder: Path) -> str:
    """Return the part with spectrograms and sounds, as many contacts as fit the page; or an empty text."""
    found: dict[str, list[str]] = {}
    size = 0
    for contact in _contacts(records):
        block = _contact_block(contact, folder)
        if size + len(block) > LARGEST:
            break
        size += len(block)
        facts = contact.record
        label = facts.name if facts.name in ("", facts.identifier) else f"{facts.identifier}: {facts.name}"
        title = ", ".join(filter(None, (label or facts.identifier, facts.material)))
        found.setdefault(title, []).append(block)
    if not found:
        return ""
    words = (
        "Test contacts. The recording comes first; all sounds of a contact are scaled by the same gain, except those "
        "that would clip, which are scaled to full scale. Spectrograms show time to the right and frequency upwards on "
        "a logarithmic scale; colors span 80 dB below the recording's loudest point."
    )
    blocks = "".join(f"<h3>{escape(title)}</h3>{''.join(each)}" for title, each in found.items())
    return f'<section id="listen"><h2>Spectrograms and sounds</h2><p>{escape(words)}</p>{blocks}</section>'


def _contact_block(contact: StoredContact, folder: Path) -> str:
    recorded = StoredSound.read(folder / contact.recorded)
    loudest = loudest_of(recorded)
    seconds, lowest, highest = picture_span(recorded)
    span = f"{seconds:.2g} s, {lowest:.0f} Hz to {highest:.0f} Hz"
    cards = [_card("recorded", span, recorded, loudest, contact.name, kind=' class="recorded"')]
    several = len({case.label for case, _ in contact.made}) > 1
    for case, outcome in contact.made:
        title = f"{outcome.method}, {case.label}" if several else outcome.method
        row = case.test.index(contact.name)
        scores = [
            f"{heading} {figure(values[row])}"
            for metric, heading in (("l1", "L1"), ("l1_log", "L1-log"), ("relative_stft", "relative STFT"))
            if (values := outcome.values.get(metric)) is not None
        ]
        sound = StoredSound.read(folder / outcome.sounds[contact.name])
        cards.append(_card(title, ", ".join(scores), sound, loudest, contact.name))
    return f'<h4>{escape(contact.name)}</h4><div class="sounds">{"".join(cards)}</div>'


def _card(title: str, words: str, sound: StoredSound, loudest: float, contact: str, *, kind: str = "") -> str:
    said = escape(f"{title}, {contact}")
    return (
        f'<figure{kind}><img alt="Spectrogram: {said}" src="{draw_spectrogram(sound, loudest=loudest)}">'
        f'<audio controls preload="none" aria-label="Sound: {said}" src="{sound.address}"></audio>'
        f"<figcaption><b>{escape(title)}</b>{escape(words)}</figcaption></figure>"
    )
