"""Where a surface of triangles is closest to a place, exactly."""

from dataclasses import dataclass
from itertools import chain
from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import cKDTree

from avmsf.compiled import compiled


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

    def __call__(self, places: Float64[np.ndarray, "places 3"]) -> Closest:
        """Return the closest points."""
        bound = np.min([tree.query(places)[0] for tree in self._trees], axis=0)
        closest = Closest(
            np.zeros(len(places), dtype=np.int64), np.zeros((len(places), 3)), np.full(len(places), np.inf)
        )
        for group, tree in zip(self._groups, self._trees, strict=True):
            found = tree.query_ball_point(places, bound * (1 + 1e-9) + self._reach[group].max())
            ends = np.cumsum([len(each) for each in found], dtype=np.int64)
            among = group[np.fromiter(chain.from_iterable(found), dtype=np.int64, count=sum(map(len, found)))]
            _take_closer(self._triangles, places, among, ends, closest.rows, closest.weights, closest.distances)
        return closest


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _take_closer(triangles, places, among, ends, rows, weights, distances):
    """Where one of the triangles `among`, up to `ends` of them for each place, is closer, write it down."""
    begin = 0
    for place in range(len(places)):
        for triangle in among[begin : ends[place]]:
            one, other, apart = _on_triangle(triangles[triangle], places[place])
            if apart < distances[place] or (apart == distances[place] and triangle < rows[place]):
                rows[place], distances[place] = triangle, apart
                weights[place, 0], weights[place, 1], weights[place, 2] = 1.0 - one - other, one, other
        begin = ends[place]


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _on_triangle(corners, place):
    """Return the second and third barycentric coordinate of a triangle's point closest to a place, and how far it is.

    That is the foot of the perpendicular where it falls inside, and the closest point of the three sides elsewhere.
    """
    first, second, third = corners[0], corners[1], corners[2]
    a, b, c, p, q = 0.0, 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        one, other, toward = second[axis] - first[axis], third[axis] - first[axis], place[axis] - first[axis]
        a, b, c = a + one * one, b + one * other, c + other * other
        p, q = p + one * toward, q + other * toward
    area = a * c - b * b
    # A triangle without area has only sides.
    if area > 0.0:
        v, w = (c * p - b * q) / area, (a * q - b * p) / area
        if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
            return v, w, _apart(corners, place, v, w)
    part = _along(first, second, place)
    v, w, least = part, 0.0, _apart(corners, place, part, 0.0)
    part = _along(first, third, place)
    apart = _apart(corners, place, 0.0, part)
    if apart < least:
        v, w, least = 0.0, part, apart
    part = _along(second, third, place)
    apart = _apart(corners, place, 1.0 - part, part)
    if apart < least:
        v, w, least = 1.0 - part, part, apart
    return v, w, least


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _along(start, end, place):
    """Return which part of the way from start to end is closest to a place."""
    product, square = 0.0, 0.0
    for axis in range(3):
        side = end[axis] - start[axis]
        product, square = product + side * (place[axis] - start[axis]), square + side * side
    return min(max(product / square, 0.0), 1.0) if square > 0.0 else 0.0


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _apart(corners, place, v, w):
    """Return how far a place is from the point of a triangle with these coordinates."""
    square = 0.0
    for axis in range(3):
        there = (1.0 - v - w) * corners[0, axis] + v * corners[1, axis] + w * corners[2, axis]
        square += (there - place[axis]) ** 2
    return np.sqrt(square)
