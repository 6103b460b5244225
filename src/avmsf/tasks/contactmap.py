"""Where a blow may have fallen: a score and a probability for every point of the surface."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.summary import short_repr
from avmsf.errors import LocationError
from avmsf.scene.symmetry import Symmetries
from avmsf.tasks.counterparts import Counterpart, name_counterpart

LEVEL = 0.9
"""Probability that a credible region holds, where nothing else is asked for."""
COMPARABLE = 0.25
"""Part of the likeliest place's probability from which on another place is as good an answer."""
_LEAST_LEFT = 0.01
"""Part of a sound that detuned modes leave at least: less is not told from rounding and from what noise adds."""
_NEIGHBOR_SPACINGS = 2.5
_NEIGHBOR_PART = 0.04


@dataclass(frozen=True, eq=False)
class Peak:
    """A place, as large as it may be, where the blow may have fallen."""

    __repr__ = short_repr

    row: int
    """Its likeliest point."""
    position: Float32[Tensor, " 3"]
    """Where that is, object frame, meters."""
    probability: float
    """That the blow fell here: of all points that hang together with this one."""
    points: Bool[Tensor, " points"]
    """Which points these are."""


@dataclass(frozen=True, eq=False)
class ContactMap:
    """Scores of all points of a surface for one blow (paper, section Contact Localization, and beyond it)."""

    def __repr__(self) -> str:
        if self.refusal is not None:
            return f"ContactMap({len(self.points)} points, no position: {self.refusal})"
        _, *others = self.peaks()
        where = ", ".join(f"{value + 0.0:.3f}" for value in self.position.tolist())
        more = f", {len(others)} more positions as probable" if others else ""
        radius = f"{LEVEL:.0%} within {1e3 * self.credible_radius():.2g} mm"
        return f"ContactMap({len(self.points)} points, most probable ({where}) m, {radius}{more})"

    points: Float32[Tensor, "points 3"]
    """Object frame, meters."""
    distance: Float64[Tensor, " points"]
    """The paper's cosine distance between heard and foretold gains, for a blow of either polarity: 0 where they agree
    up to a factor, 1 where they have nothing in common."""
    probability: Float64[Tensor, " points"]
    """That the blow fell on the part of the surface that a point stands for; sums to one."""
    explained: float
    """Part of the sound's energy, without its noise, that a blow at the field's likeliest point explains, 0 to 1."""
    modal: float
    """Part of the same energy that the object's modes explain if each may be as strong as it likes, 0 to 1."""
    detuned: float
    """Part of it that they explain on the mean when they are put out of tune, 0 to 1."""
    force: float = 1.0
    """Strength of that blow, with its sign, relative to one that sounds as the field renders it."""
    notes: tuple[str, ...] = field(default=())
    """What a user should know of the recording, in sentences."""
    evidence: float = math.inf
    """Log Bayes factor of a blow somewhere on the object against noise (see `avmsf.tasks.posterior`): 0 where both
    explain the sound's gains equally well."""
    refusal: str | None = None
    """Why the sound has no place, as another object's; None where it has one."""

    @property
    def best(self) -> int:
        """Row of the point of least distance: the paper's answer. It knows no uncertainty; see `position`."""
        return int(torch.argmin(self.distance))

    @property
    def misfit(self) -> float:
        """What the object's modes leave of the sound over what they leave out of tune: own sounds 0, others about 1."""
        return (1.0 - self.modal) / max(1.0 - self.detuned, _LEAST_LEFT)

    @property
    def most_probable(self) -> int:
        """Row of the most probable point."""
        return int(torch.argmax(self.probability))

    @property
    def position(self) -> Float32[Tensor, " 3"]:
        """Where the most probable point is, object frame, meters. Raises LocationError after a `refusal`."""
        if self.refusal is not None:
            raise LocationError(self.refusal, name="position", value=self.misfit)
        return self.points[self.most_probable]

    def region(self, level: float = LEVEL) -> Bool[Tensor, " points"]:
        """Return the smallest set of points that holds the blow with a probability of `level` or more.

        Raises LocationError for a level that is not between 0 and 1.
        """
        _expect_probability(level)
        order = torch.argsort(self.probability, descending=True, stable=True)
        before = torch.cumsum(self.probability[order], 0) - self.probability[order]
        inside = torch.zeros(len(self.points), dtype=torch.bool)
        inside[order[before < level]] = True
        return inside

    def credible_radius(self, level: float = LEVEL) -> float:
        """Return the distance from `position` within which the contact lies with a probability of `level`, meters.

        Raises LocationError as `region`, and after a `refusal`.
        """
        _expect_probability(level)
        order = torch.argsort(self._distances, stable=True)
        reached = torch.cumsum(self.probability[order], 0) >= level * self.probability.sum()
        return float(self._distances[order][int(reached.double().argmax())])

    @property
    def position_std(self) -> float:
        """Root mean square distance of the contact from `position`, meters. Raises LocationError after a `refusal`."""
        return float((self.probability * self._distances.square()).sum().sqrt())

    @property
    def _distances(self) -> Float64[Tensor, " points"]:
        return (self.points.double() - self.position.double()).norm(dim=1)

    @cached_property
    def linking_length(self) -> float:
        """Meters up to which two points of a region are taken to be one place.

        Two and a half times the distance between neighboring points, and no less than 4 % of the object's diagonal.
        """
        places = self.points.double().numpy()
        diagonal = float(np.linalg.norm(np.ptp(places, axis=0)))
        if len(places) < 2:
            return diagonal
        spacing = float(np.median(cKDTree(places).query(places, k=2)[0][:, 1]))
        return max(_NEIGHBOR_SPACINGS * spacing, _NEIGHBOR_PART * diagonal)

    def peaks(self, level: float = LEVEL, *, comparable: float = COMPARABLE) -> tuple[Peak, ...]:
        """Return the separate places in the credible region, likeliest first, whose probabilities are comparable.

        A place is a set of the region's points that are linked by steps of at most `linking_length`. Comparable is what
        has at least that part of the first place's probability. Raises as `region`.
        """
        rows = torch.nonzero(self.region(level)).flatten()
        places = self.points[rows].double().numpy()
        pairs = cKDTree(places).query_pairs(self.linking_length, output_type="ndarray")
        links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
        count, labels = connected_components(links, directed=False)
        found = []
        for label in range(count):
            own = rows[torch.from_numpy(labels == label)]
            row = int(own[torch.argmax(self.probability[own])])
            members = torch.zeros(len(self.points), dtype=torch.bool)
            members[own] = True
            found.append(Peak(row, self.points[row], float(self.probability[own].sum()), members))
        found.sort(key=lambda peak: (-peak.probability, peak.row))
        return tuple(peak for peak in found if peak.probability >= comparable * found[0].probability)

    @property
    def ambiguous(self) -> bool:
        """Whether several separate places are comparably probable."""
        return len(self.peaks()) > 1

    def counterparts(self, symmetries: Symmetries | None = None, level: float = LEVEL) -> tuple[Counterpart, ...]:
        """Return the other places that are about as probable as the first, and how the object's symmetries explain it.

        Of the symmetries, that one is named which carries the first place nearest to the other, if nearer than twice
        `linking_length`. Empty where the answer is not ambiguous. Raises as `region`.
        """
        first, *others = self.peaks(level)
        return tuple(
            name_counterpart(
                first.position,
                other.position,
                symmetries,
                probability=other.probability,
                tolerance=2.0 * self.linking_length,
            )
            for other in others
        )


def _expect_probability(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise LocationError.expected("a probability between 0 and 1, such as 0.9", level, name="level")
