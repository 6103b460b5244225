"""Sounds at a common rate, length and level, for comparison."""

from fractions import Fraction

import torch
from jaxtyping import Float
from scipy.signal import resample_poly
from torch import Tensor

Sounds = Float[Tensor, "contacts samples"]
"""One a row."""


def resampled(sounds: Sounds, *, sample_rate: float, wanted: float) -> Float[Tensor, "contacts resampled"]:
    """Return sounds at another sample rate, Hz, by a polyphase filter; they are not differentiable in what was given.

    What lies above half the lower of the two rates is lost. Dtype and device stay. The ratio of the rates is the
    nearest with a denominator up to 20,000, exact for all rates in use.
    """
    if sample_rate == wanted:
        return sounds
    ratio = (Fraction(wanted) / Fraction(sample_rate)).limit_denominator(20_000)
    found = resample_poly(sounds.detach().cpu().double().numpy(), ratio.numerator, ratio.denominator, axis=1)
    return torch.from_numpy(found).to(sounds)


def with_length(sounds: Sounds, samples: int) -> Float[Tensor, "contacts lasting"]:
    """Return sounds of `samples` samples: cut at the end, or continued by silence."""
    missing = samples - sounds.shape[1]
    return torch.nn.functional.pad(sounds, (0, missing)) if missing > 0 else sounds[:, :samples]


def level(sounds: Sounds, *, sample_rate: float) -> Float[Tensor, " contacts"]:
    """Return each sound's root mean square over its loudest 20 ms, which does not depend on its decay time.

    That is about how long loudness integrates a click. Differentiable; never zero, so that it can be a divisor.
    """
    window = min(sounds.shape[1], max(1, round(0.02 * sample_rate)))
    power = torch.nn.functional.avg_pool1d(sounds.square()[:, None], window, max(1, window // 4))[:, 0]
    return power.amax(dim=1).clamp_min(torch.finfo(sounds.dtype).tiny).sqrt()


def levelled(sounds: Sounds, like: Sounds, *, sample_rate: float) -> Sounds:
    """Return sounds scaled, row for row, to the level of `like`."""
    return sounds * (level(like, sample_rate=sample_rate) / level(sounds, sample_rate=sample_rate))[:, None]
