"""Gains as thin-plate splines over the training contacts: the field that reads positions alone."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor

from avmsf.field.doubtedgains import Belief
from avmsf.field.gainfield import Gains
from avmsf.field.records import count_of, like
from avmsf.field.thinplate import SplineSites, fit_spline, places_of

_UNDETERMINED = 1e-9
"""Diagonal of the inverse over its largest, below which it is zero but for rounding (about 1e-13): the other sites do
not determine the linear function."""
_ASTRAY = 0.02
"""Standard error of measured gains over their root mean square, at least: hammers do not hit twice alike."""


@dataclass(frozen=True, eq=False)
class ThinPlateGains:
    """Splines through the gains of all modes, smoothed alike."""

    points: Float32[Tensor, "points 3"]
    """Points of the object's surface, object frame, metres."""
    contacts: Float64[Tensor, "contacts 3"]
    """Where the gains are known, metres."""
    values: Float64[Tensor, "contacts modes 2"]
    """Gains there along each mode's phase and a quarter of a period ahead, as if all blows came from one side."""
    smoothing: float
    """Of the splines, see `SplineSites`."""
    measured: Float64[Tensor, "contacts modes 2"] | None = None
    """The gains that the field's own modes have in the recordings, by which it judges itself; None for `values`."""

    kind: ClassVar[str] = "spline"

    @cached_property
    def sites(self) -> SplineSites:
        """How values at the contacts spread."""
        return SplineSites(self.contacts, self.smoothing)

    @property
    def report(self) -> dict[str, Any]:
        """What the splines are, as plain values."""
        return {"kernel": "thin plate" if self.sites.bending else "distance", "smoothing": self.smoothing}

    def at(self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None) -> Gains:
        """Return the splines' gains, whichever way the contacts are struck."""
        modes = self.values.shape[1]
        parts = (self.sites.weights(contacts) @ self.values.flatten(1)).reshape(-1, modes, 2).float()
        return Gains(parts[..., 0], parts[..., 1])

    def deviation(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts modes 2"] | None:
        """Return the deviation of a random field whose mean the splines are (kriging), scaled by leaving sites out.

        None where all contacts are in one place: these say nothing of how gains vary.
        """
        if len(self.sites.sites) == 1:
            return None
        variance = self.sites.field_variance(self.values.flatten(1)).reshape(-1, 2)
        return (self.sites.spread(contacts)[:, None, None] * variance).sqrt().float()

    def smoother(self) -> Float64[Tensor, "modes 2 contacts contacts"]:
        """Return what each contact's value counts for at each contact, the same for all modes."""
        return self.sites.weights(self.contacts).expand(self.values.shape[1], 2, -1, -1)

    @property
    def noise(self) -> Float64[Tensor, "contacts modes 2"]:
        """Standard error of the gains at the contacts: what the splines leave of them, and a little at least."""
        values = self.values.flatten(1)
        left = (values - self.sites.weights(self.contacts) @ values).reshape(self.values.shape)
        size = self.values.square().mean((0, 2)).sqrt()
        noise = torch.maximum(left.square().mean(0).sqrt(), _ASTRAY * size[:, None])
        return noise.expand(len(self.contacts), -1, -1)

    @property
    def trusted(self) -> Bool[Tensor, " contacts"]:
        """All: splines doubt no contact."""
        return torch.ones(len(self.contacts), dtype=torch.bool)

    def judged_by(self, measured: Float64[Tensor, "contacts modes 2"]) -> "ThinPlateGains":
        """Return the same splines, which judge themselves by these gains."""
        return replace(self, measured=measured)

    @property
    def places(self) -> int:
        """Sites of the splines, each of contacts in one place."""
        return len(self.sites.sites)

    def ways(self, places: Float[Tensor, "places 3"], directions: Float[Tensor, "places 3"] | None) -> None:
        """Return None: all blows count as if they came from one side."""
        return

    def beliefs(
        self,
        places: Float64[Tensor, "places 3"],
        ways: Float64[Tensor, "places 3"] | None,
        *,
        weights: Float64[Tensor, " modes"],
    ) -> Iterator[Belief]:
        """Return what is not known of all modes at once, by kriging: they differ by a factor."""
        variance = self.sites.field_variance(self.values.flatten(1)).reshape(-1, 2).sum(1)
        noise = self.noise.square().mean(0).sum(1)
        yield Belief(float((variance * weights).sum()) * self.sites.covariance(places), float((noise * weights).sum()))

    def without(self, contacts: Bool[Tensor, " contacts"]) -> "ThinPlateGains":
        """Return splines as smooth through the other contacts."""
        kept = ~contacts
        measured = None if self.measured is None else self.measured[kept]
        return replace(self, contacts=self.contacts[kept], values=self.values[kept], measured=measured)

    def left_out(self) -> Float64[Tensor, "sites modes 2"]:
        """Return each site's errors over their foretold deviations, judged by the measured gains."""
        flat = self.values.flatten(1)
        errors = self.sites.left_out(flat)
        single = torch.diagonal(self.sites.inverse)[: len(errors)].abs()
        spread = (self.sites.field_variance(flat) / single[:, None]).sqrt()
        if self.measured is not None:
            errors = errors + self.sites.means(self.measured.flatten(1) - flat)
        return (errors / spread.clamp_min(torch.finfo(torch.float64).tiny)).reshape(len(errors), -1, 2)

    def leave_one_out(self) -> Float64[Tensor, "contacts modes 2"]:
        """Return the gains at each contact's place by equally smooth splines through the contacts of all other places.

        In closed form, but for what changes without a place: where the others lie in a plane or on a line, or are too
        few for a linear function, the splines are solved for again.
        """
        flat, owner = self.values.flatten(1), places_of(self.contacts)
        single = torch.diagonal(self.sites.inverse)[: self.places].abs()
        again = single < _UNDETERMINED * single.max()
        again |= SplineSites(self.contacts[owner > 0], 0.0).bending != self.sites.bending
        predicted = (self.sites.means(flat) - self.sites.left_out(flat))[owner].reshape(self.values.shape)
        for place in torch.nonzero(again).flatten():
            known = self.without(owner == place).at(self.contacts[owner == place])
            assert known.quadrature is not None
            predicted[owner == place] = torch.stack([known.mean, known.quadrature], dim=2).double()
        return predicted

    def with_values(self, values: Float64[Tensor, "contacts modes 2"]) -> "ThinPlateGains":
        """Return the same splines through other gains."""
        return replace(self, values=values)

    def take(self, modes: Int[Tensor, " modes"]) -> "ThinPlateGains":
        """Return the field of the given modes, in the given order."""
        measured = None if self.measured is None else self.measured[:, modes]
        return replace(self, values=self.values[:, modes], measured=measured)

    def record(self) -> dict[str, Any]:
        """Return the sizes and the smoothing."""
        return {
            "points": len(self.points),
            "contacts": len(self.contacts),
            "modes": self.values.shape[1],
            "smoothing": self.smoothing,
        }

    def tensors(self) -> dict[str, Tensor]:
        """Return the points, the contacts and the gains there."""
        measured = self.values if self.measured is None else self.measured
        return {"points": self.points, "contacts": self.contacts, "values": self.values, "measured": measured}

    @classmethod
    def skeleton(cls, record: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return tensors like those of a field of these sizes."""
        points, contacts, modes = (count_of(record[name], name) for name in ("points", "contacts", "modes"))
        if like(record["smoothing"], 0.0, "smoothing") < 0:
            raise ValueError(f"smoothing is {record['smoothing']}")
        return {
            "points": torch.empty(points, 3, device="meta"),
            "contacts": torch.empty(contacts, 3, dtype=torch.float64, device="meta"),
            "values": torch.empty(contacts, modes, 2, dtype=torch.float64, device="meta"),
            "measured": torch.empty(contacts, modes, 2, dtype=torch.float64, device="meta"),
        }

    @classmethod
    def restore(cls, record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> "ThinPlateGains":
        """Return the field."""
        smoothing = float(record["smoothing"])
        return cls(tensors["points"], tensors["contacts"], tensors["values"], smoothing, tensors["measured"])


def thin_plate_gains(
    contacts: Float[Tensor, "contacts 3"],
    values: Float64[Tensor, "contacts modes 2"],
    *,
    importance: Float[Tensor, " modes"],
    points: Float[Tensor, "points 3"],
) -> ThinPlateGains:
    """Return splines through gains at contacts in metres, smoothed as `fit_spline` does, each mode by its importance.

    Raises FitError where there is no contact.
    """
    spline = fit_spline(contacts, values.flatten(1), importance=importance.double().repeat_interleave(2))
    return ThinPlateGains(points.float(), contacts.double(), values, spline.sites.smoothing)
