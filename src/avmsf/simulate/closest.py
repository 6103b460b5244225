"""Where a surface of triangles is closest to a place, exactly."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import cKDTree

_PAIRS = 2_000_000
"""Pairs of places and triangles that are compared at a time."""


@dataclass(frozen=True, eq=False)
class Closest:
    """The closest points of a surface."""

    rows: Int[np.ndarray, " places"]
    """The triangle that each lies on; the first of several."""
    weights: Float64[np.ndarray, "places 3"]
    """Barycentric coordinates in it, 0 to 1."""
    distances: Float64[np.ndarray, " places"]
    """Metres."""


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

    def __call__(self, places: Float64[np.ndarray, "places 3"]) -> Closest:
        """Return the closest points."""
        bound = np.min([tree.query(places)[0] for tree in self._trees], axis=0)
        lists = []
        for group, tree in zip(self._groups, self._trees, strict=True):
            found = tree.query_ball_point(places, bound * (1 + 1e-9) + self._reach[group].max(), return_sorted=True)
            lists.append([group[each] for each in found])
        candidates = [np.sort(np.concatenate(each)) for each in zip(*lists, strict=True)]
        rows = np.empty(len(places), dtype=np.int64)
        weights, distances = np.empty((len(places), 3)), np.empty(len(places))
        lengths = np.array([len(each) for each in candidates], dtype=np.int64)
        for chunk in _chunks(lengths):
            owners = np.repeat(np.arange(chunk.start, chunk.stop), lengths[chunk])
            among = np.concatenate(candidates[chunk])
            inside, apart = _on_triangles(self._triangles[among], places[owners])
            order = np.lexsort((among, apart, owners))
            best = order[np.concatenate([[True], owners[order][1:] != owners[order][:-1]])]
            rows[chunk], weights[chunk], distances[chunk] = among[best], inside[best], apart[best]
        return Closest(rows, weights, distances)


def _chunks(lengths: Int[np.ndarray, " places"]) -> list[slice]:
    """Return slices of the places with at most `_PAIRS` candidates each, or one place."""
    ends = np.cumsum(lengths)
    slices, start = [], 0
    while start < len(lengths):
        before = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + _PAIRS, side="right")))
        slices.append(slice(start, stop))
        start = stop
    return slices


def _on_triangles(
    triangles: Float64[np.ndarray, "pairs 3 3"], places: Float64[np.ndarray, "pairs 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric coordinates [pairs, 3] of the point of each triangle closest to its place, and how far it is.

    That is the foot of the perpendicular where it falls inside, and the closest point of the three sides elsewhere.
    """
    first, one, other = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    toward = places - first
    a, b, c = (one * one).sum(1), (one * other).sum(1), (other * other).sum(1)
    p, q = (one * toward).sum(1), (other * toward).sum(1)
    area = a * c - b * b
    # A triangle without area has only sides.
    safe = np.where(area > 0, area, 1.0)
    v, w = (c * p - b * q) / safe, (a * q - b * p) / safe
    inside = (area > 0) & (v >= 0) & (w >= 0) & (v + w <= 1)
    options = [np.where(inside[:, None], np.stack([1 - v - w, v, w], axis=1), [1.0, 0.0, 0.0])]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        side = triangles[:, end] - triangles[:, start]
        length = (side * side).sum(1)
        along = ((places - triangles[:, start]) * side).sum(1) / np.where(length > 0, length, 1.0)
        part = np.clip(along, 0.0, 1.0)
        weights = np.zeros((len(places), 3))
        weights[:, start], weights[:, end] = 1.0 - part, part
        options.append(weights)
    stacked = np.stack(options)
    apart = np.linalg.norm(np.einsum("opc,pcd->opd", stacked, triangles) - places, axis=-1)
    best, pairs = apart.argmin(axis=0), np.arange(len(places))
    return stacked[best, pairs], apart[best, pairs]
