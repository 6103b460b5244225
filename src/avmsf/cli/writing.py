"""What the commands write: wav files, each complete or not at all."""

import io
import math
from pathlib import Path

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


def peak_factor(
    sounds: Float[Tensor, "contacts samples"], *, level_db: float = -1.0, coding: Coding = "float32"
) -> float:
    """Return the one factor on all sounds by which the loudest peaks at a level against full scale, dB."""
    peak = float(sounds.abs().max())
    full = 1.0 if coding == "float32" else _LARGEST_INT16 / 2**15
    return 10 ** (level_db / 20) * (full / peak if peak > 0 else 1.0)


def write_sound(
    path: Path, sound: Float[Tensor, " samples"], *, sample_rate: float, coding: Coding = "float32"
) -> None:
    """Write a mono wav file. Raises `OutputError` for samples that are not finite and for what would clip."""
    if wrong := int((~torch.isfinite(sound)).sum()):
        got, advice = f"{wrong} of {len(sound)} that are not", "fit the field again, or choose a smaller force or level"
        raise OutputError.expected("finite samples", wrong, got=got, file=path, name="finite", advice=advice)
    scaled, rate = sound.numpy().astype(np.float32), round(sample_rate)
    if coding == "float32":
        write_whole(path, wav_bytes(scaled, rate))
        return
    peak = float(np.abs(scaled).max(initial=0.0))
    if round(peak * 2**15) > _LARGEST_INT16:
        got = f"{peak:.3g} ({20 * math.log10(peak):+.1f} dB)"
        wanted, advice = "amplitudes below 1 for 16 bits", "add --normalize peak, lower --level-db, or write float32"
        raise OutputError.expected(wanted, peak, got=got, file=path, name="peak", advice=advice)
    memory = io.BytesIO()
    # Rounded here: libsndfile rounds down.
    soundfile.write(memory, np.rint(scaled * 2**15).astype(np.int16), rate, subtype="PCM_16", format="WAV")
    write_whole(path, memory.getvalue())
