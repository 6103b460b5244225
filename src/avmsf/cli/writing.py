"""What the commands write: wav files, figures and texts, each complete or not at all."""

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import soundfile
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.render import Coding

SUBTYPES = {"float32": "FLOAT", "int16": "PCM_16"}
_LARGEST_INT16 = 2**15 - 1
FULL_SCALE: dict[Coding, float] = {"float32": 1.0, "int16": _LARGEST_INT16 / 2**15}
"""Largest sample of each format."""


@dataclass(frozen=True)
class Level:
    """The level at which sounds are written."""

    normalize: Literal["none", "peak"] = "none"
    """none: unchanged. peak: all sounds times one factor, so that the loudest reaches full scale."""
    level_db: float = 0.0
    """Additional gain, dB."""

    def factor(self, sounds: Float[Tensor, "contacts samples"], *, coding: Coding = "float32") -> float:
        """Return the factor on all sounds: one for all preserves the differences in level between contacts."""
        peak = float(sounds.abs().max())
        gain = 10 ** (self.level_db / 20)
        return gain * FULL_SCALE[coding] / peak if self.normalize == "peak" and peak > 0 else gain


def write_sound(path: Path, sound: Float[Tensor, " samples"], *, sample_rate: float, coding: Coding) -> None:
    """Write a mono wav file. Raises `OutputError` for a rate that wav files cannot hold, for samples that
    are not finite and for what would clip."""
    rate = round(sample_rate)
    if rate < 1:
        raise OutputError.expected(
            "a sample rate of 1 Hz or more", sample_rate, got=f"{sample_rate:g} Hz", file=path, name="sample_rate"
        )
    wrong = int((~torch.isfinite(sound)).sum())
    if wrong:
        raise OutputError(
            f"{path}: expected finite samples, got {wrong} of {len(sound)} that are not; fit the field again, or "
            "choose a smaller force or level",
            file=path,
            name="finite",
            value=wrong,
        )
    peak = float(sound.abs().max()) if len(sound) else 0.0
    if coding == "int16" and round(peak * 2**15) > _LARGEST_INT16:
        raise OutputError(
            f"{path}: expected amplitudes below 1 for 16 bits, got {peak:.3g} ({20 * math.log10(peak):+.1f} dB); add "
            "--normalize peak, lower --level-db, or write float32",
            file=path,
            name="peak",
            value=peak,
        )
    memory = io.BytesIO()
    scaled = sound.numpy().astype(np.float32)
    # Rounded here: libsndfile rounds down.
    samples = np.rint(scaled * 2**15).astype(np.int16) if coding == "int16" else scaled
    soundfile.write(memory, samples, rate, subtype=SUBTYPES[coding], format="WAV")
    write_whole(path, memory.getvalue())


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    write_whole(path, text)
