"""How well a motion carries a cloud onto itself.

The cloud is divided by chance into two halves, and a motion is judged by how it carries points of the one onto the
surface that the other one samples. A symmetry does that as well as leaving the points where they are: what noise and
uneven cover do to distances, they do to both, and it is taken away.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from avmsf.gaussians.neighborhoods import Neighborhoods, read_neighborhoods
from avmsf.symmetry.motions import Motion

_REACH = 3.0
"""Distance in spacings from which on a point has no counterpart; counted distances end here."""
_STRAY = 1.0
"""Distance in spacings from which on a point is looked at together with the others that stray."""
_CONTINUING = 0.45
"""Part of a stray piece's border that has to continue the surface beyond an open edge for the piece to fill a hole."""
_OPEN = 0.22
"""Length of `Neighborhoods.openings` from which on a point lies at an edge of what was seen."""


@dataclass(frozen=True)
class Alignment:
    """How well a motion carries the cloud onto itself."""

    error: float
    """Root mean square distance of moved points to the surface, without what noise alone makes, in spacings. Distances
    count up to 3 spacings, and those of points that fall into a hole not at all."""
    missing: float
    """Part of the points that fall into a hole."""


@dataclass(frozen=True, eq=False)
class Halves:
    """A cloud in two halves: points to be moved, drawn evenly by area, and a surface that they should meet."""

    queries: Float[np.ndarray, "queries 3"]
    target: Neighborhoods
    tree: cKDTree
    spacing: float
    """Median spacing of the target, or what stands for it, in the unit of the points: that of the errors."""
    noise: float
    """Mean square distance of queries that are not moved, in spacings squared."""
    edge: float
    """Part of the queries that, not moved, lie beyond an open edge."""

    @classmethod
    def of(
        cls,
        points: Float[np.ndarray, "points 3"],
        count: int,
        *,
        bounds: tuple[float, float],
        generator: np.random.Generator,
    ) -> "Halves":
        """Divide a cloud, and draw `count` queries from one half; errors are in spacings, kept within `bounds`."""
        order = generator.permutation(len(points))
        moved, target = (read_neighborhoods(points[order[part::2]]) for part in (0, 1))
        areas = moved.spacing**2
        # Some points in a cloud lie alone: they would stand for much more than they show.
        areas = np.minimum(areas, 4 * np.median(areas))
        chosen = generator.choice(len(areas), min(count, len(areas)), replace=False, p=areas / areas.sum())
        spacing = float(np.clip(np.median(target.spacing), *bounds))
        blank = cls(moved.points[chosen], target, cKDTree(target.points), spacing, noise=0.0, edge=0.0)
        distance, missing = blank.compare(blank.queries)
        return replace(blank, noise=float((distance[~missing] ** 2).mean()), edge=float(missing.mean()))

    def compare(
        self, moved: Float[np.ndarray, "queries 3"]
    ) -> tuple[Float[np.ndarray, " queries"], Bool[np.ndarray, " queries"]]:
        """Return distances to the surface in spacings, up to 3, and which points fall into holes.

        Where there is a counterpart the distance is taken along the normal, since nothing marks a place within a
        surface.
        """
        reach, row = self.tree.query(moved)
        normal = np.abs(np.einsum("ni,ni->n", moved - self.target.points[row], self.target.normals[row]))
        lost = reach > _REACH * np.maximum(self.target.spacing[row], self.spacing)
        distance = np.where(lost, _REACH, np.minimum(normal / self.spacing, _REACH))
        return distance, _in_holes(moved, self.target, row, distance > _STRAY)

    def align(self, motion: Motion) -> Alignment:
        """Judge a motion."""
        distance, missing = self.compare(motion.apply(self.queries))
        square = float((distance[~missing] ** 2).mean()) if not missing.all() else _REACH**2
        return Alignment(math.sqrt(max(square - self.noise, 0.0)), max(0.0, float(missing.mean()) - self.edge))


def _in_holes(
    moved: Float[np.ndarray, "queries 3"],
    target: Neighborhoods,
    row: Int[np.ndarray, " queries"],
    stray: Bool[np.ndarray, " queries"],
) -> Bool[np.ndarray, " queries"]:
    """Return which points fall beyond an open edge of the surface, where it may have been before a hole was left.

    Stray points that hang together share a verdict, made where they border on the surface: points of a hole's filling
    follow on from an edge, within the plane that the surface has there; those of a part that the object has on one side
    only, a mug's handle, stand on the midst of the surface or off its plane.
    """
    away = moved - target.points[row]
    reach = np.linalg.norm(away, axis=1)
    opening, normal = target.openings[row], target.normals[row]
    length = np.linalg.norm(opening, axis=1)
    onward = (length > _OPEN) & (np.einsum("ni,ni->n", away, opening) > 0.5 * reach * length)
    level = np.abs(np.einsum("ni,ni->n", away, normal)) < 0.45 * reach
    missing = onward & (reach > target.spacing[row])
    rows = np.flatnonzero(stray)
    if len(rows) == 0:
        return missing
    piece = _pieces(moved[rows], link=6.0 * float(np.median(cKDTree(moved).query(moved, k=2)[0][:, 1])))
    bordering = reach[rows] < 2.0 * _REACH * target.spacing[row[rows]]
    continuing = np.bincount(piece, weights=bordering & (onward & level)[rows])
    borders = np.bincount(piece, weights=bordering)
    missing[rows] = (continuing > _CONTINUING * np.maximum(borders, 1.0))[piece]
    return missing


def _pieces(points: Float[np.ndarray, "points 3"], *, link: float) -> Int[np.ndarray, " points"]:
    """Return the number of the piece that each point belongs to; points nearer than `link` hang together."""
    pairs = cKDTree(points).query_pairs(link, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1].astype(np.int64)
