"""The posterior of the contact of one impact: a distance and a probability for every point of the surface."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_floats, as_vectors, short_repr
from avmsf._utils.text import counted
from avmsf.errors import LocationError
from avmsf.mesh.points import connected_parts

LEVEL = 0.9
"""Probability of a credible region by default."""
MIN_PEAK_PROBABILITY = 0.05
"""Probability from which on another peak is reported: half of what lies outside a region of 90 %."""
LOCATED, NOT_LOCATED = "located", "not located"
"""Status of a recording."""
_LEAST_RESIDUAL = 0.01
"""Lower bound of the energy fraction that detuned modes leave: less is within rounding and noise."""


@dataclass(frozen=True, eq=False)
class Peak:
    """A connected set of points where the contact may be."""

    __repr__ = short_repr

    row: int
    """Index of its most probable point."""
    position: Float32[Tensor, " 3"]
    """Where that is, object frame, meters."""
    probability: float
    """That the contact is one of its points."""
    points: Bool[Tensor, " points"]
    """Which points it contains."""


@dataclass(frozen=True, eq=False)
class ContactPosterior:
    """The posterior of one impact's contact over the points of a surface, and the paper's cosine distance.

    See the paper's section Contact Localization. Methods with a `level` raise LocationError for one that is not between
    0 and 1, and what depends on the position raises it where the recording was rejected, by `refusal`.
    """

    def __repr__(self) -> str:
        notes = f"\nnote: {'; '.join(self.notes)}" if self.notes else ""
        if self.refusal is not None:
            return f"ContactPosterior({len(self.points)} points, no position: {self.refusal}){notes}"
        where = ", ".join(f"{value + 0.0:.3f}" for value in self.position.tolist())
        others = len(self.peaks()) - 1
        more = f", {counted(others, 'other possible position')}" if others else ""
        radius = f"{LEVEL:.0%} within {1e3 * self.credible_radius():.2g} mm"
        return f"ContactPosterior({len(self.points)} points, most probable ({where}) m, {radius}{more}){notes}"

    points: Float32[Tensor, "points 3"]
    """Object frame, meters."""
    distance: Float64[Tensor, " points"]
    """The paper's cosine distance between recorded and predicted gains, for an impact of either polarity: 0 where they
    agree up to a factor, 1 where they are orthogonal."""
    probability: Float64[Tensor, " points"]
    """That the contact is on the part of the surface that a point represents; sums to one. NaN where the recording was
    rejected."""
    explained_energy: float
    """Fraction of the sound's energy, without its noise, that an impact at the point of greatest likelihood explains,
    0 to 1."""
    modal_energy: float
    """Fraction of the same energy that the object's modes explain with free amplitudes, 0 to 1."""
    null_energy: float
    """Fraction of it that they explain on average when detuned, 0 to 1: the null model."""
    force: float = 1.0
    """Force of that impact, with its sign, relative to one that sounds as the field renders it."""
    notes: tuple[str, ...] = field(default=())
    """What a user should know about the recording, in sentences."""
    evidence: float = math.inf
    """Log Bayes factor of an impact somewhere on the object against noise (see `avmsf.localization.likelihood`): 0
    where both explain the sound's gains equally well."""
    refusal: str | None = None
    """Why the recording was rejected, as that of another object; None if it was located."""

    def rejected(self, reason: str) -> "ContactPosterior":
        """Return the map without a position and with NaN for every probability, and the reason as its `refusal`."""
        return replace(self, probability=torch.full_like(self.probability, math.nan), refusal=reason)

    @property
    def best(self) -> int:
        """Index of the point of least cosine distance, the paper's answer, which has no uncertainty; see `position`."""
        return int(torch.argmin(self.distance))

    @property
    def mismatch_ratio(self) -> float:
        """Energy that the object's modes do not explain over that which detuned modes do not explain.

        0 to .3 for recordings of the object, mostly above .5 for those of others.
        """
        return (1.0 - self.modal_energy) / max(1.0 - self.null_energy, _LEAST_RESIDUAL)

    @property
    def most_probable(self) -> int:
        """Index of the most probable point."""
        self._check_located("most_probable")
        return int(torch.argmax(self.probability))

    @property
    def position(self) -> Float32[Tensor, " 3"]:
        """The most probable position, object frame, meters."""
        self._check_located("position")
        return self.points[self.most_probable].clone()

    def region(self, level: float = LEVEL) -> Bool[Tensor, " points"]:
        """Return the smallest set of points that contains the contact with a probability of `level` or more."""
        self._check_located("region")
        _check_probability(level)
        order = torch.argsort(self.probability, descending=True, stable=True)
        before = torch.cumsum(self.probability[order], 0) - self.probability[order]
        inside = torch.zeros(len(self.points), dtype=torch.bool)
        inside[order[before < level]] = True
        return inside

    def contains(self, contact: ArrayLike, level: float = LEVEL) -> bool:
        """Return whether `region` contains the point that is nearest to a contact, [3], object frame, meters.

        Raises ArrayError for what is no position, and LocationError where the recording was rejected.
        """
        position = as_vectors(as_floats(contact, "contact")[None], "contact")[0].double()
        return bool(self.region(level)[(self.points.double() - position).norm(dim=1).argmin()])

    def credible_radius(self, level: float = LEVEL) -> float:
        """Return the distance from `position` within which the contact lies with a probability of `level`, meters."""
        _check_probability(level)
        order = torch.argsort(self._distances, stable=True)
        reached = torch.cumsum(self.probability[order], 0) >= level * self.probability.sum()
        return float(self._distances[order][int(reached.double().argmax())])

    @property
    def position_std(self) -> float:
        """Root mean square distance of the contact from `position`, meters."""
        return float((self.probability * self._distances.square()).sum().sqrt())

    @property
    def _distances(self) -> Float64[Tensor, " points"]:
        return (self.points.double() - self.position.double()).norm(dim=1)

    @cached_property
    def linking_length(self) -> float:
        """Meters up to which two points of a region belong to one peak.

        Two and a half times the distance between neighboring points, and no less than 4 % of the object's diagonal.
        """
        positions = self.points.double().numpy()
        diagonal = float(np.linalg.norm(np.ptp(positions, axis=0)))
        if len(positions) < 2:
            return diagonal
        spacing = float(np.median(cKDTree(positions).query(positions, k=2)[0][:, 1]))
        return max(2.5 * spacing, 0.04 * diagonal)

    def peaks(self, level: float = LEVEL, *, least: float = MIN_PEAK_PROBABILITY) -> tuple[Peak, ...]:
        """Return the peaks of the credible region that hold a probability of `least` or more, the largest first.

        A peak is a set of the region's points that are linked by steps of at most `linking_length`. The one that
        contains `position`, the most probable point, is always among them; a larger peak may be broader and lower.
        """
        rows = torch.nonzero(self.region(level)).flatten()
        positions = self.points[rows].double().numpy()
        pairs = cKDTree(positions).query_pairs(self.linking_length, output_type="ndarray")
        labels = connected_parts(pairs, len(rows))
        found = []
        for label in np.unique(labels):
            own = rows[torch.from_numpy(labels == label)]
            row = int(own[torch.argmax(self.probability[own])])
            members = torch.zeros(len(self.points), dtype=torch.bool)
            members[own] = True
            found.append(Peak(row, self.points[row].clone(), float(self.probability[own].sum()), members))
        found.sort(key=lambda peak: (-peak.probability, peak.row))
        return tuple(peak for peak in found if peak.probability >= least or peak.points[self.most_probable])

    @property
    def multimodal(self) -> bool:
        """Whether the contact may be at several positions apart: more than one of the `peaks` of the 90 % region."""
        return len(self.peaks()) > 1

    def equivalent_points(self, level: float = LEVEL) -> tuple[Peak, ...]:
        """Return the other possible positions, those of all `peaks` without `position`, the largest peak first."""
        return tuple(each for each in self.peaks(level) if not each.points[self.most_probable])

    def describe(self, level: float = LEVEL) -> dict[str, Any]:
        """Return the results as plain values, lengths in meters; of a rejected recording the status and the reason.

        `position_probability` is that of the peak of the region that contains the position.
        """
        common = {
            "explained_energy": self.explained_energy,
            "modal_energy": self.modal_energy,
            "mismatch_ratio": self.mismatch_ratio,
            "log_bayes_factor": self.evidence,
            "notes": list(self.notes),
        }
        if self.refusal is not None:
            return not_located(self.refusal) | common
        others = self.equivalent_points(level)
        own = next(peak for peak in self.peaks(level) if peak.points[self.most_probable])
        return {
            "status": LOCATED,
            "position": self.position.tolist(),
            "position_probability": own.probability,
            "credible_region": {
                "probability": level,
                "radius": self.credible_radius(level),
                "surface_fraction": float(self.region(level).double().mean()),
            },
            **common,
            "force": self.force,
            "cosine": {"position": self.points[self.best].tolist(), "distance": float(self.distance[self.best])},
            "multimodal": bool(others),
            "equivalent_points": [
                {"position": each.position.tolist(), "probability": each.probability} for each in others
            ],
        }

    def _check_located(self, name: str) -> None:
        if self.refusal is not None:
            raise LocationError(self.refusal, name=name, value=self.mismatch_ratio)


def not_located(reason: str) -> dict[str, Any]:
    """Return the values for a recording that could not be located."""
    return {"status": NOT_LOCATED, "reason": " ".join(reason.split()), "position": None}


def _check_probability(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise LocationError.expected("a probability between 0 and 1, such as 0.9", level, name="level")
