"""A field that sounds the same wherever it is struck, so that one recording is its whole truth."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from avmsf.field.gains.model import Gains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.modal.modes import ModalBank
from factories.made_fields import StandIn, sounding

RATE = 8000.0
FREQUENCY = (310.0, 565.0, 905.0, 1420.0, 1990.0, 2710.0)
DAMPING = (9.0, 12.0, 16.0, 25.0, 40.0, 60.0)
GAINS = (1.0, -0.8, 0.9, 0.6, -0.7, 0.4)


@dataclass(frozen=True, eq=False)
class SameGains(StandIn):
    """Gains that do not depend on the place."""

    gains: torch.Tensor
    points: ClassVar[torch.Tensor] = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])

    def predict(self, points, directions=None) -> Gains:
        return Gains(self.gains.expand(len(points), -1))


def ringing_field(*, pitch: float = 1.0, damping: float = 1.0, seconds: float = 0.5, level: float = 1.0) -> SoundField:
    frequency, own = (torch.tensor(each, dtype=torch.float64) for each in (FREQUENCY, DAMPING))
    bank, gains = ModalBank(pitch * frequency, damping * own), SameGains(level * torch.tensor(GAINS))
    return sounding(gains, bank=bank, noise=0.0, samples=round(seconds * RATE), origin=Origin(capture="ringing"))


def sound_of(field: SoundField) -> torch.Tensor:
    return field.render(field.gain_field.points[:1])
