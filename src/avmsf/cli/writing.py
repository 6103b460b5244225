"""What the commands write: wav files, each complete or not at all."""

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
from avmsf.capture.audio import wav_bytes
from avmsf.cli.paths import OutputError
from avmsf.cli.render import Coding

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
    rate, wrong = round(sample_rate), int((~torch.isfinite(sound)).sum())
    if rate < 1:
        got = f"{sample_rate:g} Hz"
        raise OutputError.expected("a rate of 1 Hz or more", sample_rate, got=got, file=path, name="sample_rate")
    if wrong:
        got, advice = f"{wrong} of {len(sound)} that are not", "fit the field again, or choose a smaller force or level"
        raise OutputError.expected("finite samples", wrong, got=got, file=path, name="finite", advice=advice)
    scaled = sound.numpy().astype(np.float32)
    if coding == "float32":
        write_whole(path, wav_bytes(scaled, rate))
        return
    peak = float(np.abs(scaled).max(initial=0.0))
    if round(peak * 2**15) > _LARGEST_INT16:
        got, advice = (
            f"{peak:.3g} ({20 * math.log10(peak):+.1f} dB)",
            "add --normalize peak, lower --level-db, or write float32",
        )
        raise OutputError.expected(
            "amplitudes below 1 for 16 bits", peak, got=got, file=path, name="peak", advice=advice
        )
    memory = io.BytesIO()
    # Rounded here: libsndfile rounds down.
    soundfile.write(memory, np.rint(scaled * 2**15).astype(np.int16), rate, subtype="PCM_16", format="WAV")
    write_whole(path, memory.getvalue())
