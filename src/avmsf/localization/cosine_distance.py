"""The paper's cosine distance between predicted and recorded gains (eq. 15), for a recording of unknown delay."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex64, Complex128, Float, Float64
from torch import Tensor

from avmsf.errors import LocationError
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.finders import ShortTime

LARGEST_DELAY = 5e-4
"""Bound of the onset's error, seconds, either way."""
STEP = 0.2
"""Radians that the typical frequency turns by between two delays, of which one is within half of that: a point with the
recorded gains has a distance of .1^2 / 2 = .005 at most. It grows with the square of the frequency where `MOST_DELAYS`
limits them, from 6.4 kHz on, to .05 at 20 kHz."""
MOST_DELAYS = 201
_BATCH = 512


def delays_of(
    power: Float64[Tensor, " modes"], frequency: Float64[Tensor, " modes"], *, step: float
) -> Float64[Tensor, " delays"]:
    """Return evenly spaced delays (seconds) up to `LARGEST_DELAY` either way, zero among them.

    From one to the next the typical frequency, the root mean square of frequencies (Hz) weighted by `power`, turns by
    `step` radians, or by more where that would take more than `MOST_DELAYS`.
    """
    typical = 2.0 * math.pi * float(((power @ frequency.square()) / power.sum()).sqrt())
    count = min(MOST_DELAYS, 1 + 2 * math.ceil(LARGEST_DELAY * typical / step))
    return torch.linspace(-LARGEST_DELAY, LARGEST_DELAY, count, dtype=torch.float64)


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
    turns = 2.0 * math.pi * frequency
    delays = delays_of(recorded.abs().square(), frequency, step=STEP)
    rotated = (recorded * torch.polar(torch.ones((), dtype=torch.float64), -delays[:, None] * turns)).to(
        torch.complex64
    )
    parts = torch.view_as_real(rotated).flatten(1).T.contiguous()
    found = [
        (torch.view_as_real(part).flatten(1) @ parts).abs().amax(1) / part.norm(dim=1).clamp_min(1e-30)
        for part in torch.split(gains, _BATCH)
    ]
    return (1.0 - torch.cat(found).double()).clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False)
class PublishedLocator:
    """A field's gains at candidate points, against those of the paper's regression (eq. 5) in a recording.

    The regression is that of the warm-up, at the bins of the field's own frequencies. Its gains have no sign, so that
    neither has a recording.
    """

    field: SoundField
    points: Float64[Tensor, "points 3"]
    """Object frame, meters."""
    gains: Float64[Tensor, "points modes"]

    @classmethod
    def of(cls, field: SoundField, points: Float[Tensor, "points 3"]) -> "PublishedLocator":
        """Return the locator over points."""
        return cls(field, points.double(), field.gains(points).double())

    def distance(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " points"]:
        """Return the cosine distance, 0 to 2, of each point's gains from a sound's; 1 at points without gains.

        The sound starts where the field's training sounds do and has their sample rate. Raises LocationError where no
        mode of the field is found in it.
        """
        given = sound.detach().cpu()[None, : self.field.samples]
        recorded = ShortTime().gains(given, self.field.bank, self.field.sample_rate)[0]
        if not bool(recorded.any()):
            raise LocationError.expected(
                "one of the field's modes", name="sound", advice="record the impact louder, or with less noise"
            )
        return 1.0 - torch.nn.functional.cosine_similarity(self.gains, recorded[None], dim=1)
