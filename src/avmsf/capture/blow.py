"""Whether a recording can be of one blow: a sound that rises at once and dies away, and is not cut off."""

import math

import numpy as np
from jaxtyping import Float64

from avmsf.capture.audio import clipped_samples
from avmsf.errors import CaptureError

_SUDDEN = 10 ** (6.0 / 20.0)
"""How far the loudest hundredth of a second must stand above the quietest, 6 dB: the least that a blow does."""


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
        raise CaptureError(
            f"{name} holds no blow: its loudest 10 ms stand {20 * math.log10(loudest / quietest):.1f} dB above its "
            "quietest, expected 6 dB at least: record a single blow with quiet before or after it"
        )


def clipping(response: Float64[np.ndarray, " frames"], *, name: str) -> str | None:
    """Return how much of a sound is cut off, in a sentence; None where nothing is."""
    clipped = clipped_samples(response)
    if not clipped:
        return None
    share = 100.0 * clipped / len(response)
    return (
        f"{name} is clipped: {clipped} samples ({share:.2g} %) are cut off at {np.abs(response).max():.3g}, which adds "
        "what no mode explains; turn the gain down"
    )
