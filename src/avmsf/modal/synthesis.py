"""Modes into sound, fast and exact, with gradients.

A decaying sine sampled at n = m K + k is the imaginary part of z^(mK) z^k with z = exp((-d + 2 pi i f) / rate): the
angle-addition rule splits it into two small tables, one over blocks m and one over the K samples of a block. Both are
made in float64, where the phase of a long sound is still exact; only their product, by far the larger part of the
work, runs in float32 as one matrix product over modes.
"""

import math

import torch
from jaxtyping import Float, Float64
from torch import Tensor

_BLOCK = 512
"""Samples in a block: the two tables are smallest together near the square root of the length, the product is
fastest from about 256 on."""


def synthesize(
    gains: Float[Tensor, "contacts modes"],
    frequency: Float64[Tensor, " modes"],
    damping: Float64[Tensor, "*contacts modes"],
    *,
    samples: int,
    sample_rate: float,
    quadrature: Float[Tensor, "contacts modes"] | None = None,
) -> Float[Tensor, "contacts samples"]:
    """Return the sum over modes of gains exp(-d t) sin(2 pi f t) (paper, eq. 3), plus quadrature's cosines if given.

    `frequency` in Hz, `damping` in 1/s, shared by all contacts or with one row a contact; differentiable in all of
    them. Modes at or above half the sample rate would alias: the caller leaves them out. The output has the dtype of
    `gains`: in float32 its error is about 1e-7 of the loudest sample, in float64 it is exact.
    """
    blocks = math.ceil(samples / _BLOCK)
    starts = torch.arange(blocks, dtype=torch.float64, device=gains.device) * (_BLOCK / sample_rate)
    steps = torch.arange(_BLOCK, dtype=torch.float64, device=gains.device) / sample_rate
    start_sine, start_cosine = _decaying_sines(frequency, damping, starts, dtype=gains.dtype)
    step_sine, step_cosine = _decaying_sines(frequency, damping, steps, dtype=gains.dtype)
    sine, cosine = gains[:, None, :] * start_sine, gains[:, None, :] * start_cosine
    if quadrature is not None:
        sine, cosine = sine + quadrature[:, None, :] * start_cosine, cosine - quadrature[:, None, :] * start_sine
    left = torch.cat([sine, cosine], dim=-1)
    right = torch.cat([step_cosine, step_sine], dim=-1)
    sounds = left.flatten(0, 1) @ right.mT if damping.ndim == 1 else left @ right.mT
    return sounds.reshape(gains.shape[0], blocks * _BLOCK)[:, :samples]


def synthesize_phased(
    gains: Float[Tensor, "contacts modes"],
    frequency: Float64[Tensor, " modes"],
    damping: Float64[Tensor, "*contacts modes"],
    phase: Float64[Tensor, " modes"],
    *,
    samples: int,
    sample_rate: float,
    quadrature: Float[Tensor, "contacts modes"] | None = None,
) -> Float[Tensor, "contacts samples"]:
    """Return the sum over modes of gains exp(-d t) sin(2 pi f t + phase), phases in radians; else as `synthesize`.

    The quadrature's cosines, too, are ahead by the phase.
    """
    turned = torch.polar(torch.ones_like(phase), phase)
    along, ahead = turned.real.to(gains.dtype), turned.imag.to(gains.dtype)
    sine, cosine = gains * along, gains * ahead
    if quadrature is not None:
        sine, cosine = sine - quadrature * ahead, cosine + quadrature * along
    return synthesize(sine, frequency, damping, samples=samples, sample_rate=sample_rate, quadrature=cosine)


def _decaying_sines(
    frequency: Float64[Tensor, " modes"],
    damping: Float64[Tensor, "*contacts modes"],
    times: Float64[Tensor, " times"],
    *,
    dtype: torch.dtype,
) -> tuple[Float[Tensor, "*contacts times modes"], Float[Tensor, "*contacts times modes"]]:
    """Return exp(-d t) sin(2 pi f t) and exp(-d t) cos(2 pi f t), made in float64."""
    decay = torch.exp(-damping[..., None, :] * times[:, None])
    phase = 2 * math.pi * frequency * times[:, None]
    return (decay * torch.sin(phase)).to(dtype), (decay * torch.cos(phase)).to(dtype)
