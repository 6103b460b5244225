"""Elastic mode shapes where a field looks them up: at points of the object's surface."""

from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.scene.points import farthest_points
from avmsf.simulate.elastic import ElasticModes

_PLACES = 500
"""Points that stand for the whole surface where all would be too many."""
_NEIGHBOURS = 4
"""Points that a place's shapes are interpolated between."""


@dataclass(frozen=True, eq=False)
class ElasticPoints:
    """Points of an object's surface with how they move in each elastic mode."""

    points: Float32[Tensor, "points 3"]
    """Object frame, metres."""
    inward: Float32[Tensor, "points 3"]
    """Unit vectors straight into the body: the way of a blow of which no direction is known."""
    shapes: Float32[Tensor, "points shapes 3"]
    """Displacements; each shape's component along `inward` has a mean square of one."""

    @classmethod
    def of(cls, elastic: ElasticModes, points: Float[Tensor, "points 3"]) -> "ElasticPoints":
        """Return the shapes where the body's surface is nearest to each point; each body's last are kept.

        The same body is asked at the same points for outliers, for the choice between gain models and for the fit.
        """
        kept = _KEPT.get(elastic)
        if kept is not None and torch.equal(kept[0], points.double()):
            return kept[1]
        found = cls._looked_up(elastic, points)
        _KEPT[elastic] = (points.double().clone(), found)
        return found

    @classmethod
    def _looked_up(cls, elastic: ElasticModes, points: Float[Tensor, "points 3"]) -> "ElasticPoints":
        shapes, normals = elastic.at_with_normals(points)
        inward = -normals
        size = torch.einsum("pkd,pd->pk", shapes, inward).square().mean(0).sqrt()
        scaled = shapes / size.clamp_min(torch.finfo(torch.float64).tiny)[:, None]
        return cls(points.float(), inward.float(), scaled.float())

    @property
    def size(self) -> float:
        """Diagonal of the box around the points, metres."""
        return float((self.points.amax(0) - self.points.amin(0)).norm())

    @cached_property
    def spread(self) -> Int[Tensor, " places"]:
        """Rows of 500 points that lie as far apart as they go, or of all where there are fewer."""
        return farthest_points(self.points, min(_PLACES, len(self.points)))

    def along(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None
    ) -> tuple[Float64[Tensor, "contacts shapes"], Float64[Tensor, "contacts 3"]]:
        """Return the shapes' components along blows at contacts, and the blows' directions.

        Directions of length zero are not known, and taken straight into the surface, as all are without `directions`.
        """
        rows, weights = self._near(contacts)
        # A neighbour at a time: the shapes of all at once would be several times the result.
        moved = sum(weights[:, near, None, None] * self.shapes[rows[:, near]].double() for near in range(rows.shape[1]))
        assert isinstance(moved, Tensor)
        # On a thin wall the nearest point may be on its other side; what lies in the place's own plane is on its own.
        offsets = contacts.double()[:, None] - self.points[rows].double()
        side = (offsets * self.inward[rows].double()).sum(2).abs().argmin(1)
        straight = self.inward[rows[torch.arange(len(rows)), side]].double()
        used = straight
        if directions is not None:
            length = directions.double().norm(dim=1, keepdim=True)
            used = torch.where(length > 0, directions.double() / length.clamp_min(1e-300), straight)
        return torch.einsum("ckd,cd->ck", moved, used), used

    def _near(self, contacts: Float[Tensor, "contacts 3"]) -> tuple[Tensor, Float64[Tensor, "contacts near"]]:
        near = min(_NEIGHBOURS, len(self.points))
        distances, rows = self._tree.query(contacts.double().numpy(), k=near)
        distances = np.reshape(distances, (len(contacts), near))
        weights = 1.0 / (distances**2 + 1e-18 * self.size**2)
        return (
            torch.from_numpy(np.reshape(rows, (len(contacts), near))),
            torch.from_numpy(weights / weights.sum(axis=1, keepdims=True)),
        )

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points.double().numpy())


_KEPT: WeakKeyDictionary[ElasticModes, tuple[Tensor, ElasticPoints]] = WeakKeyDictionary()
