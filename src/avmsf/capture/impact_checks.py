"""Whether a recording can be of one impact: a sound that rises at once and decays, and is not clipped."""

import math

import numpy as np
from jaxtyping import Float64

from avmsf.capture.audio import clipped_samples
from avmsf.errors import CaptureError

_SUDDEN = 10 ** (6.0 / 20.0)
"""How far the loudest hundredth of a second must stand above the quietest, 6 dB: the least that an impact does."""


def expect_sudden(sound: Float64[np.ndarray, " samples"], *, sample_rate: float, name: str) -> None:
    """Raise `CaptureError` for a sound that neither rises nor falls: a hum, or noise.

    Sounds shorter than 80 ms are too short to tell.
    """
    size = max(64, math.ceil(0.01 * sample_rate))
    if len(sound) < 8 * size:
        return
    frames = sound[: len(sound) // size * size].reshape(-1, size)
    levels = np.sqrt(np.mean((frames - frames.mean(axis=1, keepdims=True)) ** 2, axis=1))
    loudest, quietest = float(levels.max()), float(np.quantile(levels, 0.1))
    if loudest < _SUDDEN * quietest:
        level = 20 * math.log10(loudest / quietest)
        raise CaptureError(
            f"{name}: expected an impact, its loudest 10 ms at least 6 dB above its quietest, got {level:.1f} dB; "
            "record a single impact with silence before or after it",
            file=name,
            value=level,
        )


def clipping(response: Float64[np.ndarray, " frames"], *, name: str) -> str | None:
    """Return a message on how much of a sound is clipped; None where nothing is."""
    clipped = clipped_samples(response)
    if not clipped:
        return None
    share = 100.0 * clipped / len(response)
    return (
        f"{name}: {clipped} samples ({share:.2g} %) are clipped at {np.abs(response).max():.3g}, which no mode can "
        "explain; turn the gain down and record it again"
    )
