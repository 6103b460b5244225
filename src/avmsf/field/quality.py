"""How well a field predicts its own contacts from each other: errors by leave-one-out, and the verdict on them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.field.config import FitConfig
from avmsf.field.losses import spectral_loss, spectral_target


@dataclass(frozen=True)
class FieldQuality:
    """Relative STFT errors at training contacts, each predicted from those at all other positions."""

    positions: int
    """Positions that were left out in turn, each with all of its recordings."""
    error: float
    """Of the field; modes, and the prior of its gain model's hypotheses, are those of all contacts."""
    nearest_mean: float
    """Of the mean of the three nearest recordings at other positions."""
    next_contact: tuple[float, float, float] | None = None
    """The contact (object frame, meters) that reduces the field's expected error most; None if there is no other."""
    next_distance: float | None = None
    """From there to the nearest contact that was recorded, meters."""
    standard_error: float = 0.0
    """Of the difference between the field's error and the smaller one of nearest recordings, over the positions."""
    nearest: float | None = None
    """Of the nearest recording at another position; None in fields of versions before 0.9."""

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> "FieldQuality":
        """Return it from plain values, as they are in a file."""
        contact = record.get("next_contact")
        return cls(**{**record, "next_contact": None if contact is None else tuple(contact)})

    def __str__(self) -> str:
        """Return the verdict, and the advice if there is any."""
        return " ".join(filter(None, [self.verdict, self.advice]))

    @property
    def verdict(self) -> str:
        """How good the field is. Leaving out mostly overstates the error: spread contacts are far from each other."""
        averaged = self.nearest is None or self.nearest_mean <= self.nearest
        simple = "the mean of the three nearest recordings" if averaged else "the nearest recording"
        if self.level == 0:
            return (
                f"By leave-one-out, the relative STFT error of the field is about {self.error:.2f}, of {simple} "
                f"{self._simple_error:.2f} ({self.positions} positions)."
            )
        found = "worse than" if self.level == 2 else "hardly better than"
        return (
            f"Warning: by leave-one-out, the field is {found} {simple}: relative STFT "
            f"errors of {self.error:.2f} and {self._simple_error:.2f} ({self.positions} positions). Look for mistakes "
            "by avmsf check: recordings given to other contacts, a mesh in another frame or of another object. Record "
            "more positions; without a mesh, add one, or photographs, a video or Gaussians."
        )

    @property
    def level(self) -> int:
        """0 for a field better than the nearest recording and the mean of three by a standard error, 2 if worse."""
        gained = self._simple_error - self.error
        return 0 if gained > self.standard_error else 1 if gained >= -self.standard_error else 2

    @property
    def _simple_error(self) -> float:
        return self.nearest_mean if self.nearest is None else min(self.nearest, self.nearest_mean)

    @property
    def advice(self) -> str:
        """Where another impact would help most; empty if that is not known."""
        if self.next_contact is None or self.next_distance is None:
            return ""
        where = ", ".join(f"{value + 0.0:.3f}" for value in self.next_contact)
        return (
            f"Another impact near ({where}) m, {1000 * self.next_distance:.0f} mm from the nearest contact, would help "
            "most."
        )


class PlaceErrors:
    """Relative STFT errors of sounds at the contacts of recordings, averaged over the recordings of each place.

    Repeats at one place are not independent: they share what the other places predict of it.
    """

    def __init__(self, train: Impacts, places: Int[Tensor, " contacts"], config: FitConfig) -> None:
        sizes, hops, _ = config.resolutions(train.sample_rate)
        self.targets = [spectral_target(each[None], fft_sizes=sizes, hops=hops) for each in train.sounds.float()]
        loud = torch.tensor([[float(at.norms.sum()) for at in each.resolutions] for each in self.targets])
        self.weight = (loud / loud.mean(0).clamp_min(torch.finfo(loud.dtype).tiny)).mean(1) / len(sizes)
        self.places, self.repeats = places, torch.bincount(places)

    def __call__(self, sounds: Float[Tensor, "contacts samples"]) -> Float[Tensor, " places"]:
        """Return the errors of sounds at the recordings' contacts."""
        pairs = zip(sounds.float(), self.targets, strict=True)
        errors = self.weight * torch.stack([spectral_loss(each[None], target) for each, target in pairs])
        return errors.new_zeros(len(self.repeats)).index_add(0, self.places, errors) / self.repeats


def smallest_within_error(errors: Float[Tensor, "choices places"]) -> int:
    """Return the first choice whose mean error is within one standard error, of the difference, of the least one."""
    more = errors - errors[errors.mean(1).argmin()]
    allowed = more.std(1) / math.sqrt(errors.shape[1])
    return int((more.mean(1) <= allowed).double().argmax())
