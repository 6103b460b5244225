"""Sums of damped sines, exact to the last digits of float64 and quick."""

import math

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

_BLOCK = 512
"""Samples between which all phases are computed anew."""


def ring(
    poles: Complex128[Tensor, " modes"],
    amplitudes: Complex128[Tensor, "contacts modes"],
    *,
    sample_rate: float,
    samples: int,
) -> Float64[Tensor, "contacts samples"]:
    """Return the real part of the sum over modes of amplitude times exp(pole t), from t = 0.

    Poles are -d + 2 pi i f. exp(s (m K + k) / rate) = exp(s m K / rate) exp(s k / rate): two small tables and one
    product of matrices.
    """
    blocks = math.ceil(samples / _BLOCK)
    within = torch.exp(poles[:, None] * (torch.arange(_BLOCK, dtype=torch.float64) / sample_rate))
    starts = torch.exp(poles[None, :] * (_BLOCK * torch.arange(blocks, dtype=torch.float64)[:, None] / sample_rate))
    weights = (amplitudes[:, None, :] * starts[None]).reshape(-1, len(poles))
    sounds = torch.cat([weights.real, -weights.imag], dim=1) @ torch.cat([within.real, within.imag])
    return sounds.reshape(len(amplitudes), -1)[:, :samples].contiguous()
