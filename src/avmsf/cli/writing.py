"""What the verbs write: wav files, pictures and texts, each whole or not at all."""

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

from avmsf.cli.options.render import Coding
from avmsf.errors import AvmsfError
from avmsf.files import write_whole

SUBTYPES = {"float32": "FLOAT", "int16": "PCM_16"}


class OutputError(AvmsfError):
    """What was asked for cannot be written as it was asked for."""


@dataclass(frozen=True)
class Level:
    """How loud sounds are written."""

    normalize: Literal["none", "peak"] = "none"
    """none: as they are. peak: all sounds by one factor, so that the loudest reaches full scale."""
    level_db: float = 0.0
    """Gain on top of that, dB."""

    def factor(self, sounds: Float[Tensor, "contacts samples"]) -> float:
        """Return what the sounds are multiplied by: one factor for all keeps loud contacts louder than faint ones."""
        peak = float(sounds.abs().max())
        gain = 10 ** (self.level_db / 20)
        return gain / peak if self.normalize == "peak" and peak > 0 else gain


def write_sound(path: Path, sound: Float[Tensor, " samples"], *, sample_rate: float, coding: Coding) -> None:
    """Write a mono wav file. Raises `OutputError` for a rate that wav files cannot hold, for samples that
    are not finite and for what would clip."""
    rate = round(sample_rate)
    if rate < 1:
        raise OutputError(f"{path}: a wav file's sample rate is a whole number of Hz, at least 1, got {sample_rate:g}")
    if not bool(torch.isfinite(sound).all()):
        raise OutputError(
            f"{path}: expected finite samples, got {int((~torch.isfinite(sound)).sum())} of {len(sound)} that are not: "
            "fit the field again, or choose a smaller force or level"
        )
    peak = float(sound.abs().max()) if len(sound) else 0.0
    # One step below full scale, which is as far as 16 bits reach upwards.
    if coding == "int16" and peak > 1 - 2**-15:
        raise OutputError(
            f"{path}: 16 bits hold amplitudes up to 1 and this sound peaks at {peak:.3g} "
            f"({20 * math.log10(peak):+.1f} dB), so it would clip: add --normalize peak --level-db -0.1, lower "
            "--level-db, or write float32"
        )
    memory = io.BytesIO()
    soundfile.write(memory, sound.numpy().astype(np.float32), rate, subtype=SUBTYPES[coding], format="WAV")
    write_whole(path, lambda place: place.write_bytes(memory.getvalue()))


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    write_whole(path, lambda place: place.write_bytes(text.encode()))


def expect_writable(path: Path) -> None:
    """Raise `OutputError` where no file can be put at `path`: before work of minutes, not after."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; name the file to write")
    folder = path.parent
    existing = next(place for place in (folder, *folder.resolve().parents) if place.exists())
    if not existing.is_dir():
        raise OutputError(f"{path}: {existing} is a file, so there can be no folder of this name; choose another place")
