"""The paper's localization as published: the cosine distance of gains (eq. 15), without delay and noise."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import LocationError
from avmsf.field.sound_field import SoundField
from avmsf.modal.extraction.finders import ShortTime


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
