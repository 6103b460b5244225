"""Sounds that are stored for listening, and pictures of them."""

import base64
import io
from dataclasses import dataclass
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
class Heard:
    """A kept sound, read back."""

    content: bytes
    """The file as it lies on the disk."""
    samples: Float64[Tensor, " samples"]
    sample_rate: float

    @classmethod
    def read(cls, path: Path) -> "Heard":
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


def draw_spectrogram(heard: Heard, *, loudest: float | None, width: int = 240, height: int = 120) -> str:
    """Return the address of a picture of a sound: time to the right, frequency upwards on a logarithmic scale.

    Colors span 80 dB below `loudest`, the largest magnitude of the recording it is compared with; None is its own.
    """
    levels = _levels(heard, width, height)
    top = float(levels.max()) if loudest is None else loudest
    shown = ((levels - top) / RANGE_DB + 1).clamp(0, 1).flip(0)
    return _png((shown * 255).round().to(torch.uint8).numpy())


def loudest_of(heard: Heard, *, width: int = 240, height: int = 120) -> float:
    """Return the level, dB, of the brightest point in a sound's picture."""
    return float(_levels(heard, width, height).max())


def picture_span(heard: Heard) -> tuple[float, float, float]:
    """Return a picture's seconds, and its lowest and highest frequency, Hz."""
    highest = heard.sample_rate / 2
    return len(heard.samples) / heard.sample_rate, min(_LOWEST, highest / 50), highest


def _levels(heard: Heard, width: int, height: int) -> Float64[Tensor, "height width"]:
    _, lowest, highest = picture_span(heard)
    return log_spectrogram(
        heard.samples, sample_rate=heard.sample_rate, lowest=lowest, highest=highest, width=width, height=height
    )


def _png(shades: UInt8[np.ndarray, "height width"]) -> str:
    picture = Image.fromarray(shades).convert("P")
    colors = (colormaps[SEQUENTIAL](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    picture.putpalette(colors.tobytes())
    memory = io.BytesIO()
    picture.save(memory, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(memory.getvalue()).decode()}"
