"""Closest points on a mesh, exactly, and where rays meet it, by Embree."""

from dataclasses import dataclass
from itertools import chain

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float64, Int
from scipy.spatial import cKDTree

_BATCH = 4096
"""Places that are sought at once."""


@dataclass(frozen=True, eq=False)
class Closest:
    """The closest points of a surface."""

    rows: Int[np.ndarray, " places"]
    """The triangle that each lies on; the first of several."""
    weights: Float64[np.ndarray, "places 3"]
    """Barycentric coordinates in it, 0 to 1."""
    distances: Float64[np.ndarray, " places"]
    """Meters."""


class ClosestPoints:
    """Finds the closest points of one surface, [triangles, 3 corners, 3], of which no triangle is a point."""

    def __init__(self, triangles: Float64[np.ndarray, "triangles 3 3"]) -> None:
        self._triangles = triangles
        middles = triangles.mean(axis=1)
        self._reach = np.linalg.norm(triangles - middles[:, None], axis=-1).max(axis=1)
        # Triangles of a size share a tree, so that one long triangle does not widen the search among all small ones.
        size = np.floor(np.log2(self._reach)).astype(int)
        self._groups = [np.flatnonzero(size == each) for each in np.unique(size)]
        self._trees = [cKDTree(middles[group]) for group in self._groups]
        self._last = np.empty((0, 3)), Closest(np.empty(0, np.int64), np.empty((0, 3)), np.empty(0))

    def __call__(self, places: Float64[np.ndarray, "places 3"]) -> Closest:
        """Return the closest points; those of the places of the last call are kept."""
        # Read once: another thread may replace it meanwhile.
        known, found = self._last
        if not np.array_equal(places, known):
            parts = [self._search(some) for some in np.array_split(places, 1 + len(places) // _BATCH)]
            rows, weights, distances = (np.concatenate(each) for each in zip(*parts, strict=True))
            found = Closest(rows, weights, distances)
            self._last = places.copy(), found
        return found

    def _search(self, places: Float64[np.ndarray, "places 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        near = [group[tree.query(places)[1]] for group, tree in zip(self._groups, self._trees, strict=True)]
        bound = np.min([_on_triangles(self._triangles[rows], places)[1] for rows in near], axis=0)
        pairs = []
        for group, tree in zip(self._groups, self._trees, strict=True):
            found = tree.query_ball_point(places, (1 + 1e-9) * (bound + self._reach[group].max()))
            counts = np.fromiter(map(len, found), dtype=np.int64, count=len(found))
            among = np.fromiter(chain.from_iterable(found), dtype=np.int64, count=int(counts.sum()))
            pairs.append((np.repeat(np.arange(len(places)), counts), group[among]))
        place, triangle = (np.concatenate(each) for each in zip(*pairs, strict=True))
        weights, apart = _on_triangles(self._triangles[triangle], places[place])
        order = np.lexsort((triangle, apart, place))
        first = order[np.searchsorted(place[order], np.arange(len(places)))]
        return triangle[first], weights[first], apart[first]


def _on_triangles(
    corners: Float64[np.ndarray, "pairs 3 3"], places: Float64[np.ndarray, "pairs 3"]
) -> tuple[Float64[np.ndarray, "pairs 3"], Float64[np.ndarray, " pairs"]]:
    """Return the barycentric coordinates of each triangle's point closest to a place, and how far it is.

    That is the foot of the perpendicular where it falls inside, and the closest point of the three sides elsewhere.
    """
    sides = corners[:, [1, 2, 2]] - corners[:, [0, 0, 1]]
    toward = places[:, None] - corners[:, [0, 0, 1]]
    squares, products = (sides * sides).sum(2), (sides * toward).sum(2)
    (a, c, _), (p, q, _), b = squares.T, products.T, (sides[:, 0] * sides[:, 1]).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        v, w = np.stack([c * p - b * q, a * q - b * p]) / (a * c - b * b)
        one, other, third = np.where(squares > 0.0, np.clip(products / squares, 0.0, 1.0), 0.0).T
    # A triangle without area has only sides.
    inside = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (a * c > b * b)
    none = np.zeros_like(one)
    v, w = np.where(inside, v, one), np.where(inside, w, none)
    tried = np.stack([[1.0 - v - w, v, w], [1.0 - other, none, other], [none, 1.0 - third, third]]).transpose(0, 2, 1)
    apart = np.linalg.norm(np.einsum("tpc,pcx->tpx", tried, corners) - places, axis=2)
    best, pairs = apart.argmin(0), np.arange(len(places))
    return tried[best, pairs], apart[best, pairs]


class RayCaster:
    """Casts rays against triangles [triangles, 3, 3], meters.

    Embree computes in float32, so the triangles are moved to the origin and given size 1.
    """

    def __init__(self, triangles: Float64[np.ndarray, "triangles 3 3"]) -> None:
        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        self._middle, self._size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self._scene = EmbreeScene()
        # The scene does not keep it alive.
        self._mesh = TriangleMesh(self._scene, ((triangles - self._middle) / self._size).astype(np.float32))

    def __call__(
        self, origins: Float64[np.ndarray, "rays 3"], directions: Float64[np.ndarray, "rays 3"], *, lead: float
    ) -> tuple[Int[np.ndarray, " rays"], Float64[np.ndarray, " rays"], Float64[np.ndarray, "rays 3"]]:
        """Return the triangle that each ray meets first, its distance, meters, and barycentric coordinates in it.

        -1 and infinite for none. `directions` are unit vectors. Rays start `lead` times the triangles' size from their
        origins, so that those that leave a triangle do not meet it.
        """
        starts = (origins - self._middle) / self._size + lead * directions
        hits = self._scene.run(starts.astype(np.float32), directions.astype(np.float32), output=1)
        rows, u, v = hits["primID"].astype(np.int64), hits["u"].astype(np.float64), hits["v"].astype(np.float64)
        distances = np.where(rows >= 0, (hits["tfar"].astype(np.float64) + lead) * self._size, np.inf)
        return rows, distances, np.stack([1 - u - v, u, v], axis=1)
