"""The paper's cosine distance between predicted and recorded gains (eq. 15), for a recording of unknown delay."""

import math

import torch
from jaxtyping import Complex64, Complex128, Float64
from torch import Tensor

LARGEST_DELAY = 5e-4
"""Bound of the onset's error, seconds, either way."""
_STEP = 0.2
"""Radians that the typical frequency turns by between two delays: 1 - cos(.1), .005, bounds what is missed."""
_MOST_DELAYS = 201
_BATCH = 512


def cosine_distance(
    gains: Complex64[Tensor, "points modes"],
    recorded: Complex128[Tensor, " modes"],
    frequency: Float64[Tensor, " modes"],
) -> Float64[Tensor, " points"]:
    """Return the cosine distance of each point's gains from recorded ones, 0 to 1, whichever sign the recording has.

    Gains are the amplitudes of sines, and of cosines as imaginary part; frequencies are in Hz. Each point has the delay
    of the recording, up to `LARGEST_DELAY`, that makes its distance least: one sample turns high modes by more than
    gains differ between points. A point or a recording without gains has the distance 1.
    """
    recorded = recorded / recorded.norm().clamp_min(torch.finfo(torch.float64).tiny)
    turns = 2.0 * math.pi * frequency
    typical = float((recorded.abs().square() @ turns.square()).sqrt())
    count = min(_MOST_DELAYS, 1 + 2 * math.ceil(LARGEST_DELAY * typical / _STEP))
    delays = torch.linspace(-LARGEST_DELAY, LARGEST_DELAY, count, dtype=torch.float64)
    turned = (recorded * torch.polar(torch.ones((), dtype=torch.float64), -delays[:, None] * turns)).to(torch.complex64)
    parts = torch.view_as_real(turned).flatten(1).T.contiguous()
    found = [
        (torch.view_as_real(part).flatten(1) @ parts).abs().amax(1) / part.norm(dim=1).clamp_min(1e-30)
        for part in torch.split(gains, _BATCH)
    ]
    return (1.0 - torch.cat(found).double()).clamp(0.0, 1.0)
