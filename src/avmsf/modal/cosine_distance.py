"""The cosine distance of gains whose recording starts a little early or late: at the delay that makes it least."""

import math

import torch
from jaxtyping import Complex64, Complex128, Float64
from torch import Tensor

LARGEST_DELAY = 5e-4
"""Bound of the onset's error, seconds, either way."""
DELAY_STEP = 0.2
"""Radians that the typical frequency turns by between two delays, of which one is within half of that: a point with the
recorded gains has a distance of .1^2 / 2 = .005 at most. It grows with the square of the frequency where `MOST_DELAYS`
limits them, from 6.4 kHz on, to .05 at 20 kHz."""
MOST_DELAYS = 201
_BATCH = 512
"""Points computed at once: few enough that their arrays stay in a processor's cache."""


def delayed_back(
    values: Complex128[Tensor, " modes"], frequency: Float64[Tensor, " modes"], *, power: Tensor, step: float
) -> tuple[Float64[Tensor, " delays"], Complex64[Tensor, "delays modes"]]:
    """Return evenly spaced delays (seconds) up to `LARGEST_DELAY` either way, zero among them, and amplitudes before.

    From one delay to the next the typical frequency, the root mean square of frequencies (Hz) weighted by `power`,
    turns by `step` radians, or by more where that would take more than `MOST_DELAYS`.
    """
    typical = 2.0 * math.pi * float(((power @ frequency.square()) / power.sum()).sqrt())
    count = min(MOST_DELAYS, 1 + 2 * math.ceil(LARGEST_DELAY * typical / step))
    delays = torch.linspace(-LARGEST_DELAY, LARGEST_DELAY, count, dtype=torch.float64)
    back = torch.polar(torch.ones((), dtype=torch.float64), -2.0 * math.pi * delays[:, None] * frequency)
    return delays, (values * back).to(torch.complex64)


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
    if not bool(recorded.any()):
        return torch.ones(len(gains), dtype=torch.float64)
    recorded = recorded / recorded.norm()
    _, rotated = delayed_back(recorded, frequency, power=recorded.abs().square(), step=DELAY_STEP)
    parts = torch.view_as_real(rotated).flatten(1).T.contiguous()
    found = [
        (torch.view_as_real(part).flatten(1) @ parts).abs().amax(1) / part.norm(dim=1).clamp_min(1e-30)
        for part in torch.split(gains, _BATCH)
    ]
    return (1.0 - torch.cat(found).double()).clamp(0.0, 1.0)
