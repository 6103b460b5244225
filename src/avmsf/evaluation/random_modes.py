"""Random modes in place of extracted ones: the paper's row without initialization."""

import math

import torch

from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.finders import lowest_frequency
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual

_MAX_FREQUENCY = 0.9
"""Highest frequency over half the sample rate."""
_MIN_QUALITY = 10.0
"""Quality factor, pi f / d, of the fastest decay."""
_NOISE = 0.01
"""Noise over the sounds' root mean square: 40 dB down."""


def random_modes(train: Impacts, *, modes: int, bins: int, generator: torch.Generator) -> Extraction:
    """Return modes drawn at random in place of extracted ones, with flat noise of `bins` bands.

    Frequencies are spread evenly over their logarithm, from the lowest that the sounds' length allows (17 Hz in 3 s) to
    nine tenths of half the sample rate; dampings likewise, from a fall by one neper over the whole sound to a quality
    factor of 10. All gains are equal, and so large that the modes have the energy of the mean sound. Nothing but this
    energy, the rate and the length are taken from `train`. Raises FitError for fewer than one mode or two bands.
    """
    if modes < 1:
        raise FitError(f"modes: expected 1 or more, got {modes}", name="modes", value=modes)
    if bins < 2:
        raise FitError(f"bins: expected 2 bands of noise or more, got {bins}", name="bins", value=bins)
    rate, samples = train.sample_rate, train.sounds.shape[1]
    lowest, highest = lowest_frequency(samples, rate), _MAX_FREQUENCY * rate / 2
    if lowest >= highest:
        raise FitError(
            f"train: expected longer recordings, got {samples} samples; use more seconds after the onset",
            name="train",
            value=samples,
        )
    chance = torch.rand(2, modes, dtype=torch.float64, generator=generator)
    frequency = torch.sort(lowest * (highest / lowest) ** chance[0]).values
    slowest = rate / samples
    fastest = torch.clamp(math.pi * frequency / _MIN_QUALITY, min=slowest)
    damping = slowest * (fastest / slowest) ** chance[1]
    power = float(train.sounds.double().square().mean())
    # A mode of gain one has the energy 1 / (4 d) over time, and so the mean power 1 / (4 d) over the duration.
    gain = math.sqrt(power * train.duration / float((1 / (4 * damping)).sum()))
    gains = torch.full((len(train), modes), gain)
    return Extraction(
        ModalBank(frequency, damping),
        gains,
        Residual(torch.full((bins,), _NOISE * math.sqrt(power))),
        torch.zeros_like(gains),
    )
