"""Modes into sound, fast and exact, with gradients.

A decaying sine sampled at n = m K + k is the imaginary part of z^(mK) z^k with z = exp((-d + 2 pi i f) / rate): two
small tables make it, one over blocks m and one over the K samples of a block. Both are made in float64, where the phase
of a long sound is still exact; only their product, by far the larger part of the work, runs in float32 as one matrix
product over modes.
"""

import math
from typing import Any

import torch
from jaxtyping import Float, Float64, Inexact
from torch import Tensor

_BLOCK = 512
"""Samples in a block: the two tables are smallest together near the square root of the length, the product is
fastest from about 256 on."""


def synthesize(
    gains: Inexact[Tensor, "contacts modes"],
    frequency: Float64[Tensor, "*#contacts modes"],
    damping: Float64[Tensor, "*#contacts modes"],
    phase: Float64[Tensor, " modes"] | None = None,
    *,
    samples: int,
    sample_rate: float,
) -> Float[Tensor, "contacts samples"]:
    """Return the sum over modes of Im(c exp((-d + 2 pi i f) t)): of real gains c sines, as in the paper's eq. 3.

    `frequency` in Hz and `damping` in 1/s, each shared by all contacts or with one row a contact; sines are ahead by
    `phase`, radians, zero without it; differentiable in all of them. Modes at or above half the sample rate would
    alias: the caller leaves them out. The output has the precision of `gains`: in float32 its error is about 1e-7 of
    the loudest sample, in float64 it is exact.
    """
    # As the real part of a exp(i x), since products of complex tables are few calls.
    amplitudes = torch.complex(gains.imag if gains.is_complex() else torch.zeros_like(gains), -gains.real)
    if phase is not None:
        amplitudes = amplitudes * torch.exp(1j * phase).to(amplitudes.dtype)
    blocks = math.ceil(samples / _BLOCK)
    options: dict[str, Any] = {"dtype": torch.float64, "device": amplitudes.device}
    # Those of a block's samples turn backwards, for Re(a b) = Re a Re conj(b) + Im a Im conj(b): a real product.
    counts = torch.arange(0, blocks * _BLOCK, _BLOCK, **options), torch.arange(0, -_BLOCK, -1, **options)
    times = torch.cat(counts)[:, None] / sample_rate
    decay, angle = torch.exp(damping[..., None, :] * -times.abs()), 2 * math.pi * frequency[..., None, :] * times
    # Processors take five times as long for torch.polar in float64.
    powers = torch.complex(decay * torch.cos(angle), decay * torch.sin(angle)).to(amplitudes.dtype)
    starts, steps = torch.tensor_split(powers, [blocks], dim=-2)
    left, right = (torch.view_as_real(each).flatten(-2) for each in (amplitudes[:, None, :] * starts, steps))
    sounds = left.flatten(0, 1) @ right.mT if powers.ndim == 2 else left @ right.mT
    return sounds.reshape(len(amplitudes), blocks * _BLOCK)[:, :samples]
