"""A report as one self-contained page: tables, spectrograms, and sounds to play."""

import base64
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import zip_longest
from pathlib import Path

import numpy as np
import soundfile
import torch
from jaxtyping import Float, Float64
from matplotlib import colormaps
from PIL import Image
from scipy.signal import resample_poly
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.errors import EvaluationError
from avmsf.evaluation.report_tables import Section, figure, render
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
    def lowest(self) -> float:
        """Hz at the lower edge of its picture; the upper one is half the sample rate."""
        return min(_LOWEST, self.sample_rate / 100)

    @cached_property
    def levels(self) -> Float64[Tensor, "height width"]:
        """Levels of its picture, dB."""
        highest = self.sample_rate / 2
        return log_spectrogram(
            self.samples, sample_rate=self.sample_rate, lowest=self.lowest, highest=highest, width=240, height=120
        )

    @property
    def address(self) -> str:
        """The file as an address that a page plays without any network."""
        return f"data:audio/flac;base64,{base64.b64encode(self.content).decode()}"


def draw_spectrogram(sound: StoredSound, *, loudest: float) -> str:
    """Return the address of a picture of a sound: time to the right, frequency upwards on a logarithmic scale.

    Colors span 80 dB below `loudest`, dB, the brightest point of the recording it is compared with.
    """
    shown = ((sound.levels - loudest) / RANGE_DB + 1).clamp(0, 1).flip(0)
    picture = Image.fromarray((shown * 255).round().to(torch.uint8).numpy()).convert("P")
    colors = (colormaps[SEQUENTIAL](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    picture.putpalette(colors.tobytes())
    memory = io.BytesIO()
    picture.save(memory, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(memory.getvalue()).decode()}"


LARGEST = 13_000_000
"""Maximum number of characters; further contacts are omitted."""
OBJECTS = 4
"""Objects with sounds on the page, evenly spaced over all."""


def page(parts: Sequence[Section], records: Sequence[ObjectRecord], folder: Path) -> str:
    """Return the complete page; sounds are read from the results' folder. Raises EvaluationError for a missing one."""
    opening, *others = parts
    listening = _listening(records, folder)
    values = {"opening": opening, "parts": others, "listening": listening, "range_db": f"{RANGE_DB:g}"}
    whole = render("report.html.jinja", **values, is_text=_is_text)
    return with_policy(whole, report_directives(whole))


def _is_text(cell: str) -> bool:
    return any(mark.isalpha() and mark != "e" for mark in cell)


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
    for contacts in zip_longest(*chosen):
        yield from filter(None, contacts)


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


_Card = dict[str, str]
"""One sound on the page: its `title`, `words` on it, and the addresses of its `picture` and its `sound`."""


def _listening(records: Sequence[ObjectRecord], folder: Path) -> dict[str, list[tuple[str, list[_Card]]]]:
    """Return the names of contacts and their sounds by the titles of their objects, as many as fit the page."""
    found: dict[str, list[tuple[str, list[_Card]]]] = {}
    size = 0
    for contact in _contacts(records):
        cards = list(_cards(contact, folder))
        size += sum(len(card["picture"]) + len(card["sound"]) for card in cards)
        if size > LARGEST:
            break
        facts = contact.record
        label = facts.name if facts.name in ("", facts.identifier) else f"{facts.identifier}: {facts.name}"
        title = ", ".join(filter(None, (label or facts.identifier, facts.material)))
        found.setdefault(title, []).append((contact.name, cards))
    return found


def _cards(contact: StoredContact, folder: Path) -> Iterator[_Card]:
    recorded = StoredSound.read(folder / contact.recorded)
    loudest, seconds = float(recorded.levels.max()), len(recorded.samples) / recorded.sample_rate

    def card(title: str, words: str, sound: StoredSound) -> _Card:
        picture = draw_spectrogram(sound, loudest=loudest)
        return {"title": title, "words": words, "picture": picture, "sound": sound.address}

    yield card("recorded", f"{seconds:.2g} s, {recorded.lowest:.0f} Hz to {recorded.sample_rate / 2:.0f} Hz", recorded)
    several = len({case.label for case, _ in contact.made}) > 1
    for case, outcome in contact.made:
        row = case.test.index(contact.name)
        scores = [
            f"{heading} {figure(values[row])}"
            for metric, heading in (("l1", "L1"), ("l1_log", "L1-log"), ("relative_stft", "relative STFT"))
            if (values := outcome.values.get(metric)) is not None
        ]
        title = f"{outcome.method}, {case.label}" if several else outcome.method
        yield card(title, ", ".join(scores), StoredSound.read(folder / outcome.sounds[contact.name]))
