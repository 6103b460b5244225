"""Tables of points whose sound is known in full, for the tests of exports."""

import numpy as np
import torch

from avmsf.export.sampled_field import SampledField

RATE, SAMPLES, POINTS, MODES = 8000.0, 1600, 9, 4


def table(
    *,
    phased: bool = False,
    spatial: bool = False,
    noisy: bool = False,
    background_force: float | None = None,
    points: int = POINTS,
    seed: int = 0,
) -> SampledField:
    draw = torch.Generator().manual_seed(seed)
    damping = 8.0 + 30.0 * torch.rand(points, MODES, generator=draw, dtype=torch.float64)
    places = torch.rand(points, 3, generator=draw) - 0.5
    return SampledField(
        places,
        torch.nn.functional.normalize(torch.randn(points, 3, generator=draw), dim=1),
        torch.tensor([412.3, 1077.7, 1081.25, 3300.1], dtype=torch.float64),
        damping if spatial else damping[0],
        torch.complex(
            torch.randn(points, MODES, generator=draw),
            torch.randn(points, MODES, generator=draw) * 0.5 if phased else torch.zeros(points, MODES),
        ),
        torch.randn(SAMPLES, generator=draw) * (0.02 if noisy else 0.0),
        RATE,
        background_force=background_force,
        name="thing",
    )


def summed(gains, frequency, damping, *, samples=SAMPLES, rate=RATE) -> np.ndarray:
    """Return the sum of damped waves, one at a time: an oracle that shares nothing with the package."""
    times = np.arange(samples) / rate
    total = np.zeros(samples)
    for gain, f, d in zip(gains, frequency, damping, strict=True):
        angle = 2 * np.pi * float(f) * times
        total += np.exp(-float(d) * times) * (float(gain.real) * np.sin(angle) + float(gain.imag) * np.cos(angle))
    return total


def apart(heard, true) -> float:
    heard, true = np.asarray(heard, dtype=np.float64), np.asarray(true, dtype=np.float64)
    return float(np.abs(heard - true).max() / np.abs(true).max())
