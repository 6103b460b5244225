"""The noise of a quiet room and of the recorder in it, without mains hum."""

import numpy as np
from jaxtyping import Float64
from scipy.fft import irfft, next_fast_len

PINK, RUMBLE, WHITE = 0.5, 0.4, 0.1
"""Parts of the noise's power: of the room, of the building, of the recorder."""
LOWEST = 20.0
"""Hz below which the spectrum does not grow any more."""


def room_noise(
    count: int, samples: int, *, sample_rate: float, generator: np.random.Generator
) -> Float64[np.ndarray, "contacts samples"]:
    """Return Gaussian noise with a root mean square of 1 on average, each row by itself.

    Half of its power is pink, 1/f; four tenths are the rumble of a building, 1/f^3; a tenth is white.
    """
    size = next_fast_len(samples, real=True)
    level = noise_levels(size, sample_rate=sample_rate)
    # A row at a time: what is drawn for one does not depend on how many follow.
    rows = []
    for _ in range(count):
        spectrum = generator.standard_normal(len(level)) + 1j * generator.standard_normal(len(level))
        rows.append(irfft(level * spectrum, size)[:samples])
    return np.stack(rows)


def noise_levels(size: int, *, sample_rate: float) -> Float64[np.ndarray, " bins"]:
    """Return what the bins of `rfft` over `size` samples are multiplied by: no offset, unit power in all."""
    frequency = np.fft.rfftfreq(size, 1.0 / sample_rate)
    bounded = np.maximum(frequency, LOWEST)
    power = np.zeros(len(frequency))
    for part, exponent in ((PINK, -1.0), (RUMBLE, -3.0), (WHITE, 0.0)):
        shape = bounded**exponent
        shape[0] = 0.0
        power += part * shape / shape.sum()
    # A bin of unit variance in its real and its imaginary part has 4 / size^2 of power, for it counts twice.
    return size * np.sqrt(power / 4.0)
