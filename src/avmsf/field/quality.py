"""What a fit found: how well its field predicts its own contacts from each other, and the most probable body.

Errors are by leave-one-out, with the verdict on them; of the body, whether any material could be so stiff.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.text import like, record_of
from avmsf.capture.impacts import Impacts
from avmsf.fem.material import MATERIALS, NOMINAL, STIFFEST, Material, factor_range
from avmsf.fem.supports import FREE
from avmsf.field.config import FitConfig
from avmsf.field.gains.elastic import FREQUENCY_ERRORS
from avmsf.field.losses import spectral_loss, spectral_target

_MARGIN = 1.3
"""Factor by which a body's stiffness over density may be off a material's: of a thickness that is 14 % off."""


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
        """Return it from plain values, as they are in a file. Raises RecordError."""
        added = dict.fromkeys(("next_contact", "next_distance", "nearest")) | {"standard_error": 0.0}
        return record_of(cls, record, "origin.report.quality", added=added)

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


@dataclass(frozen=True)
class ProbableBody:
    """The most probable body of a fit."""

    name: str
    """In words, with the thickness of its wall if it has one."""
    wall_thickness: float | None
    """Meters; None for a body without an even wall."""
    wall_interval: tuple[float, float] | None
    """That holds the thickness with a probability of 90 %, meters; None where it was not searched for."""
    stiffness_ratio: float
    """Young's modulus over density that the measured frequencies need, over that of aluminum."""
    support: str
    """How it was held."""
    unit: str
    """The unit that the frequencies say the surface is in; empty for the present one, or where none was inferred."""

    @classmethod
    def of(cls, report: Mapping[str, Any]) -> "ProbableBody | None":
        """Return it from a fit's report; None where no body is credible. Raises RecordError for a damaged report."""
        credibility = like(report.get("credibility") or {}, {}, "origin.report.credibility")
        if not credibility.get("credible"):
            return None
        name = "origin.report.bodies.0"
        best = like(next(iter(like(report.get("bodies"), [], "origin.report.bodies")), None), {}, name)
        factor, wall = like(best["frequency_factor"], 1.0, name), best["wall_thickness"]
        searched, interval = like(report.get("thickness") or {}, {}, "origin.report.thickness"), None
        if wall is not None:
            wall = like(wall, 0.0, name)
            if searched:
                low, high = (like(searched[each], 0.0, "origin.report.thickness") for each in ("low", "high"))
                interval = low, high
        support, unit = (like(best.get(key, other), "", name) for key, other in (("support", FREE), ("unit", "")))
        return cls(like(best["body"], "", name), wall, interval, factor**2, support, unit)

    def __str__(self) -> str:
        """Return all of it in words."""
        interval = ""
        if self.wall_interval is not None:
            low, high = (1000 * each for each in self.wall_interval)
            interval = f", 90 % interval of the wall {low:.2g} to {high:.2g} mm"
        # The name of a held body says where it is held.
        free = f", {FREE}" if self.support == FREE else ""
        return f"{self.name}{interval}{free}, {self.specific_stiffness}"

    @property
    def materials(self) -> tuple[Material, ...]:
        """Those of the table that may be so stiff for their weight.

        The frequencies of a wall go with its thickness, so that an interval of the thickness is one of the ratio.
        """
        low, high = self._ratio / _MARGIN, self._ratio * _MARGIN
        if self.wall_thickness is not None and self.wall_interval is not None:
            low *= (self.wall_thickness / self.wall_interval[1]) ** 2
            high *= (self.wall_thickness / self.wall_interval[0]) ** 2
        return tuple(each for each in MATERIALS.values() if low <= each.young / each.density <= high)

    @property
    def specific_stiffness(self) -> str:
        """Young's modulus over density in words, with the materials that have it."""
        *most, last = [each.name for each in self.materials] or ["no material of the table"]
        return f"E/rho {self._ratio / 1e6:.2g} MJ/kg: as {', '.join(most)}{' or ' if most else ''}{last}"

    @property
    def _ratio(self) -> float:
        return self.stiffness_ratio * NOMINAL.young / NOMINAL.density

    @property
    def warning(self) -> str:
        """Say that the surface's unit is another one, or the body stiffer than any material of the table; else empty.

        With the margin of `factor_range`, beyond which no factor has a prior.
        """
        if self.unit:
            return (
                f"The unit of the mesh is probably {self.unit}, by the frequencies of the modes: write "
                f'unit = "{self.unit}" in capture.toml (and views_unit, for photographs), or state the present unit '
                "there as surface_unit."
            )
        # No larger factor is allowed: one that is within a step of the grid would have been larger.
        if math.sqrt(self.stiffness_ratio) * (1.0 + FREQUENCY_ERRORS[0]) <= factor_range()[1]:
            return ""
        over = self._ratio / (STIFFEST.young / STIFFEST.density)
        wrong, measure = "body", "check the unit of the mesh"
        if self.wall_thickness is not None:
            wrong = f"wall of {1000 * self.wall_thickness:.2g} mm"
            measure = "measure the wall and give --set body.wall=METERS"
        return (
            f"The fit needs {over:.2g} times the stiffness-to-density ratio of {STIFFEST.name}, the stiffest material "
            f"of the table, so the {wrong} is probably wrong, as where directions of impacts on edges are missing: "
            f"give nx,ny,nz for impacts on edges and handles, or {measure}."
        )

    def record(self) -> dict[str, Any]:
        """Return it as plain values, with the warning."""
        return asdict(self) | {"warning": self.warning or None}
