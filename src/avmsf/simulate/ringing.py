"""Sums of damped sines, exact to the last digits of float64 and quick."""

import math

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

_BLOCK = 512
"""Samples between which all phases are computed anew."""


def recorded(
    poles: Complex128[Tensor, " modes"],
    amplitudes: Complex128[Tensor, "contacts modes"],
    starts: Float64[Tensor, " contacts"],
    *,
    sample_rate: float,
    samples: int,
) -> Float64[Tensor, "contacts samples"]:
    """Return what `ring` gives for recordings whose sounds start at the samples `starts`, and zero before.

    Starts may lie between samples: amplitudes are those at the start, and each sample has the sound's exact value at
    its time after it. Nothing is interpolated. Of a sound that starts before the recording (negative), the rest is
    heard.
    """
    first = starts.ceil().clamp(min=0.0)
    late = (first - starts) / sample_rate
    sounds = ring(poles, amplitudes * torch.exp(poles * late[:, None]), sample_rate=sample_rate, samples=samples)
    whole = torch.zeros_like(sounds)
    for row, begin in enumerate(first.long().tolist()):
        whole[row, begin:] = sounds[row, : samples - begin]
    return whole


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
