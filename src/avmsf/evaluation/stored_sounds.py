"""Sounds that are stored with the results, to be listened to and drawn."""

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

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
from avmsf.evaluation.results import CaseRecord, ObjectRecord, Outcome
from avmsf.plotting.spectrograms import RANGE_DB, log_spectrogram
from avmsf.plotting.style import SEQUENTIAL

RECORDED = "recorded"
"""What the recordings are called next to the methods."""
_PEAK = 0.25
"""What recordings peak at, of full scale: louder sounds of a method have room above."""
_MIN_RATE_HZ = 8000.0
"""Below it browsers do not play."""
_FULL_SCALE = 1 - 2**-15
_LOWEST_HZ = 60.0
"""Lower edge of pictures, which are logarithmic in frequency above it."""


def listening_gain(recorded: Float[Tensor, " samples"]) -> float:
    """Return the gain of a recording and of the predictions next to it."""
    peak = float(recorded.abs().max())
    return _PEAK / peak if peak > 0 else 1.0


def write_sound(path: Path, sound: Float[Tensor, " samples"], *, sample_rate: float, gain: float) -> None:
    """Write a sound times `gain` as a FLAC file of 16 bits; what would clip is turned down to full scale.

    Sounds at rates that browsers do not play are resampled by a whole factor. Raises EvaluationError.
    """
    factor = max(1, int(np.ceil(_MIN_RATE_HZ / sample_rate)))
    samples = resample_poly(sound.double().numpy() * gain, factor, 1)
    samples = samples * min(1.0, _FULL_SCALE / max(float(np.abs(samples).max(initial=0.0)), _FULL_SCALE))
    memory = io.BytesIO()
    soundfile.write(memory, samples, round(sample_rate * factor), subtype="PCM_16", format="FLAC")
    write_whole(path, memory.getvalue(), raising=EvaluationError)


@dataclass(frozen=True, eq=False)
class StoredSound:
    """A stored sound."""

    content: bytes
    """The file as it lies on the disk."""
    samples: Float64[Tensor, " samples"]
    sample_rate: float

    @classmethod
    def read(cls, path: Path) -> "StoredSound":
        """Read a file that `write_sound` wrote. Raises EvaluationError where it is gone or damaged."""
        try:
            content = path.read_bytes()
            samples, rate = soundfile.read(io.BytesIO(content), dtype="float64")
        except (OSError, soundfile.LibsndfileError) as error:
            advice = "delete the object's file to compute it again"
            raise EvaluationError.expected("a stored sound", got=str(error), file=path, advice=advice) from error
        return cls(content, torch.from_numpy(samples), float(rate))

    @property
    def lowest(self) -> float:
        """Hz at the lower edge of its picture; the upper one is half the sample rate."""
        return min(_LOWEST_HZ, self.sample_rate / 100)

    @cached_property
    def levels(self) -> Float64[Tensor, "height width"]:
        """Levels of its picture, dB."""
        band = {"lowest": self.lowest, "highest": self.sample_rate / 2}
        return log_spectrogram(self.samples, sample_rate=self.sample_rate, width=240, height=120, **band)

    @property
    def address(self) -> str:
        """The file as an address that a page plays without any network."""
        return _address("audio/flac", self.content)


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
    return _address("image/png", memory.getvalue())


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


class StoredContact(NamedTuple):
    """One test contact of an object with stored sounds: its recording, and the predictions of all methods."""

    record: ObjectRecord
    name: str
    recorded: str
    """The recording's file."""
    made: list[tuple[CaseRecord, Outcome]]


def stored_contacts(record: ObjectRecord) -> Iterator[StoredContact]:
    """Yield an object's contacts with stored sounds."""
    files = {name: file for case in reversed(record.cases) for name, file in case.sounds.items()}
    pairs = [(case, each) for case in record.cases for each in record.outcomes if each.case == case.key]
    for name, file in files.items():
        yield StoredContact(record, name, file, [pair for pair in pairs if name in pair[1].sounds])
