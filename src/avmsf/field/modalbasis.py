"""Gains from elastic mode shapes: few taps say how much of each shape a measured mode has, physics says the rest."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor

from avmsf.field.doubtedgains import Belief
from avmsf.field.elasticpoints import ElasticPoints
from avmsf.field.evidence import Regression
from avmsf.field.gainfield import Gains
from avmsf.field.hypotheses import COUNT, UNHEARD, WIDTHS, Sites, nearness
from avmsf.field.leftout import left_out
from avmsf.field.records import count_of, like
from avmsf.field.thinplate import places_of

REACH = 0.15
"""Length of the remainder's kernel over the object's size, the diagonal of the box around it."""


@dataclass(frozen=True, eq=False)
class ModalBasis:
    """Mean gains and their doubt, by the regression of `avmsf.field.evidence`."""

    surface: ElasticPoints
    """The object's points and its elastic shapes there."""
    contacts: Float64[Tensor, "contacts 3"]
    """Where the gains are known, metres."""
    directions: Float64[Tensor, "contacts 3"]
    """Unit vectors along which the contacts were struck."""
    regression: Regression
    """What the gains at the contacts say of each mode."""
    report: dict[str, Any] = field(default_factory=dict)
    """How body and scale were chosen, as plain values; not saved."""
    measured: Float64[Tensor, "contacts modes 2"] | None = None
    """The gains that the field's own modes have in the recordings, by which it judges itself; None for `values`."""

    kind: ClassVar[str] = "physics"

    @property
    def points(self) -> Float32[Tensor, "points 3"]:
        """Points of the object's surface, object frame, metres."""
        return self.surface.points

    @property
    def values(self) -> Float64[Tensor, "contacts modes 2"]:
        """The gains at the contacts."""
        return self.regression.values

    @property
    def noise(self) -> Float64[Tensor, "contacts modes 2"]:
        """Standard error of the gains at the contacts."""
        return self.regression.noise

    def at(self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None) -> Gains:
        """Return the mean gains; a blow of which no direction is known goes straight into the surface."""
        shapes, used = self.surface.along(contacts, directions)
        weights, kernels = self.regression.expansion
        across = self._remainder(contacts.double(), used)
        parts = torch.einsum("ck,kmd->cmd", shapes, weights) + torch.einsum("cs,smd->cmd", across, kernels)
        return Gains(parts[..., 0].float(), parts[..., 1].float())

    def deviation(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts modes 2"]:
        """Return the standard deviation of what is believed of the gains."""
        shapes, used = self.surface.along(contacts, directions)
        across = self._remainder(contacts.double(), used)
        return self.regression.deviation(shapes, across, torch.ones(len(contacts), dtype=torch.float64)).float()

    @property
    def places(self) -> int:
        """Contacts that say something and are not in the same place as another."""
        return len(torch.unique(self.contacts[self.regression.hypotheses.heard], dim=0))

    def ways(
        self, places: Float[Tensor, "places 3"], directions: Float[Tensor, "places 3"] | None
    ) -> Float64[Tensor, "places 3"]:
        """Return the directions as unit vectors, or those straight into the surface."""
        return self.surface.along(places, directions)[1]

    def beliefs(
        self,
        places: Float64[Tensor, "places 3"],
        ways: Float64[Tensor, "places 3"] | None,
        *,
        weights: Float64[Tensor, " modes"],
    ) -> Iterator[Belief]:
        """Return what is not known of each mode in turn, by its likeliest hypothesis."""
        shapes, used = self.surface.along(places, ways)
        among = remainder_kernel(places, used, places, used, reach=REACH * self.surface.size)
        across = self._remainder(places, used)
        for mode, weight in enumerate(weights.tolist()):
            covariance, scatter = self.regression.posterior(mode, shapes, across, among)
            yield Belief(weight * covariance, weight * scatter)

    @property
    def trusted(self) -> Bool[Tensor, " contacts"]:
        """Whether each contact is taken to be where its label says."""
        return self.regression.doubt <= 1.0

    def smoother(self) -> Float64[Tensor, "modes 2 contacts contacts"]:
        """Return what each contact's gain counts for at each contact."""
        return self.regression.smoother

    def judged_by(self, measured: Float64[Tensor, "contacts modes 2"]) -> "ModalBasis":
        """Return the same field, which judges itself by these gains."""
        return replace(self, measured=measured)

    def without(self, contacts: Bool[Tensor, " contacts"]) -> "ModalBasis":
        """Return the field to which these contacts say nothing: so doubtful are they made."""
        doubt = torch.where(contacts, UNHEARD, self.regression.doubt)
        return replace(self, regression=replace(self.regression, doubt=doubt))

    def left_out(self) -> Float64[Tensor, "trusted modes 2"]:
        """Return each trusted contact's errors over their foretold deviations, judged by the measured gains."""
        errors, spread = self.regression.left_out
        missed = errors if self.measured is None else errors + self.measured - self.values
        scores = missed / spread.clamp_min(torch.finfo(torch.float64).tiny)
        return torch.where(self.regression.silent, torch.nan, scores)[self.trusted]

    def leave_one_out(self) -> Float64[Tensor, "contacts modes 2"]:
        """Return the gains at each contact as predicted from the contacts at all other places, of the same body.

        Hypotheses are weighted by the others' gains alone; body, frequency factor and outliers stay as they were found
        with all contacts.
        """
        known = self.regression
        return self.values - left_out(known.hypotheses, known.weights, places_of(self.contacts))[0]

    def with_values(self, values: Float64[Tensor, "contacts modes 2"]) -> "ModalBasis":
        """Return the field of other gains, with hypotheses as likely as before."""
        return replace(self, regression=self.regression.with_values(values))

    def take(self, modes: Int[Tensor, " modes"]) -> "ModalBasis":
        """Return the field of the given modes, in the given order."""
        measured = None if self.measured is None else self.measured[:, modes]
        return replace(self, regression=self.regression.take(modes), measured=measured)

    def record(self) -> dict[str, Any]:
        """Return the sizes."""
        contacts, modes, _ = self.values.shape
        return {
            "points": len(self.points),
            "shapes": self.surface.shapes.shape[1],
            "contacts": contacts,
            "modes": modes,
            "hypotheses": COUNT,
        }

    def tensors(self) -> dict[str, Tensor]:
        """Return the surface, the gains at the contacts and the hypotheses' weights."""
        known = self.regression
        return {
            "points": self.surface.points,
            "inward": self.surface.inward,
            "shapes": self.surface.shapes,
            "contacts": self.contacts,
            "directions": self.directions,
            "prior": known.prior,
            "values": known.values,
            "measured": known.values if self.measured is None else self.measured,
            "floor": known.floor,
            "doubt": known.doubt,
            "weights": known.weights,
        }

    @classmethod
    def skeleton(cls, record: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return tensors like those of a field of these sizes."""
        points, shapes, contacts, modes = (
            count_of(record[name], name) for name in ("points", "shapes", "contacts", "modes")
        )
        if like(record["hypotheses"], 1, "hypotheses") != COUNT:
            raise ValueError(f"hypotheses is {record['hypotheses']}, not {COUNT}")
        sizes: dict[str, tuple[int, ...]] = {
            "contacts": (contacts, 3),
            "directions": (contacts, 3),
            "prior": (modes, len(WIDTHS), shapes),
            "values": (contacts, modes, 2),
            "measured": (contacts, modes, 2),
            "floor": (contacts, modes),
            "doubt": (contacts,),
            "weights": (COUNT, modes, 2),
        }
        named = {name: torch.empty(size, dtype=torch.float64, device="meta") for name, size in sizes.items()}
        named |= {name: torch.empty(points, 3, device="meta") for name in ("points", "inward")}
        return named | {"shapes": torch.empty(points, shapes, 3, device="meta")}

    @classmethod
    def restore(cls, record: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> "ModalBasis":
        """Return the field."""
        surface = ElasticPoints(tensors["points"], tensors["inward"], tensors["shapes"])
        contacts, directions = tensors["contacts"], tensors["directions"]
        sites, _ = sites_of(surface, contacts, directions)
        regression = Regression(
            sites,
            tensors["prior"],
            tensors["values"],
            tensors["floor"],
            tensors["doubt"],
            tensors["weights"],
        )
        return cls(surface, contacts, directions, regression, measured=tensors["measured"])

    def _remainder(
        self, contacts: Float64[Tensor, "contacts 3"], directions: Float64[Tensor, "contacts 3"]
    ) -> Float64[Tensor, "contacts sites"]:
        return remainder_kernel(contacts, directions, self.contacts, self.directions, reach=REACH * self.surface.size)


def fit_modal_basis(
    surface: ElasticPoints,
    elastic: Float64[Tensor, " shapes"],
    contacts: Float[Tensor, "contacts 3"],
    directions: Float[Tensor, "contacts 3"] | None,
    values: Float64[Tensor, "contacts modes 2"],
    *,
    frequency: Float64[Tensor, " modes"],
    floor: Float64[Tensor, "contacts modes"],
    doubt: Float64[Tensor, " contacts"] | None = None,
) -> ModalBasis:
    """Return the field of one body, whose elastic frequencies have been scaled to the measured ones (both in Hz).

    `values` are the measured modes' gains at contacts in metres, `floor` their variance by the extraction's own error
    over each mode's mean square gain, `doubt` a factor on the noise's variance at each contact.
    """
    sites, used = sites_of(surface, contacts, directions)
    trust = torch.ones(len(contacts), dtype=torch.float64) if doubt is None else doubt
    regression = Regression.of(sites, nearness(frequency, elastic), values, floor=floor, doubt=trust)
    return ModalBasis(surface, contacts.double(), used, regression)


def sites_of(
    surface: ElasticPoints, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None
) -> tuple[Sites, Float64[Tensor, "contacts 3"]]:
    """Return what is known beforehand of the gains of blows, and their directions as unit vectors."""
    shapes, used = surface.along(contacts, directions)
    places = contacts.double()
    return Sites(shapes, remainder_kernel(places, used, places, used, reach=REACH * surface.size)), used


def remainder_kernel(
    contacts: Float64[Tensor, "contacts 3"],
    directions: Float64[Tensor, "contacts 3"],
    sites: Float64[Tensor, "sites 3"],
    site_directions: Float64[Tensor, "sites 3"],
    *,
    reach: float,
) -> Float64[Tensor, "contacts sites"]:
    """Return exp(-distance^2 / 2 reach^2) times the cosine between directions: a smooth field of displacements."""
    squares = (contacts[:, None, :] - sites).square().sum(2)
    return torch.exp(-0.5 * squares / reach**2) * (directions @ site_directions.T)
