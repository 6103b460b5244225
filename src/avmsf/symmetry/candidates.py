"""Where symmetries may be: principal axes, and pairs of points about which the surface is alike.

Two points with their normals say which plane would mirror one onto the other, and about which axis a half turn would
carry one to the other. Many pairs say something, most of it wrong; what they say is scored on a coarse picture of the
cloud, and the best that differ are kept.
"""

import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt

from avmsf.mesh.neighborhoods import Neighborhoods, describe_neighborhoods
from avmsf.symmetry.alignment import draw_by_area
from avmsf.symmetry.motions import Motions, Points, reflections, rotations

_PRIMES = (2, 3, 5, 7, 11)
_MIRRORS, _AXES, _PRINCIPAL_AXES, _TURNS = 24, 30, 9, 40
"""Candidates from matching pairs, axes among the principal ones, and turns about all axes that are fitted."""
_CELLS, _COARSE_POINTS = 56, 150
_COARSE_DISTANCE = 0.03
"""Distance in diagonals at which a moved point counts 1/e on the coarse cloud."""
_DESCRIBED, _COUNTED, _PARTNERS = 900, 1800, 24
_MIN_COSINE = math.cos(math.radians(25.0))
"""Of the angle between a point's normal and the moved one of its partner."""
_SAME_DISTANCE = 0.08
"""How far apart two candidates may carry an object that are one: a plane or axis is off by about 9 degrees."""

Lines = tuple[Float[np.ndarray, "_lines 3"], Float[np.ndarray, "_lines 3"]]
"""Unit vectors, normals of planes or along axes, and a point of each plane or axis."""
Pairs = tuple[Int[np.ndarray, " pairs"], Int[np.ndarray, " pairs"]]
"""Indices of the first and of the second points of pairs."""


def candidates(surface: Neighborhoods, queries: Points, random: np.random.Generator) -> Iterator[Motions]:
    """Yield the turns and reflections to fit: the most promising of all axes, then planes; `queries` score them."""
    coarse = CoarseCloud(surface, queries[:_COARSE_POINTS])
    principal = principal_lines(surface)
    pairs = matching_pairs(surface, random)
    main = distinct(principal, _PRINCIPAL_AXES)
    matched = coarse.best(half_turns_of_pairs(surface, pairs), _AXES, 1.0)
    axes, points = (np.concatenate(each) for each in zip(main, matched, strict=True))
    linear = np.concatenate([rotations(axis, [2 * math.pi / prime for prime in _PRIMES]) for axis in axes])
    turns = Motions.about(np.repeat(points, len(_PRIMES), axis=0), linear)
    yield from (turns[row] for row in np.argsort(-coarse.score(turns))[:_TURNS])
    for normals, points in (principal, coarse.best(mirrors_of_pairs(surface, pairs), _MIRRORS, -1.0)):
        planes = Motions.about(points, reflections(normals))
        yield from (planes[row] for row in range(len(planes)))


class CoarseCloud:
    """Distances to a cloud on a grid, and a few points to move: quick to ask, good to a fiftieth of the object."""

    def __init__(self, surface: Neighborhoods, few: Float[np.ndarray, "few 3"]) -> None:
        lowest, highest = surface.points.min(0) - 0.1, surface.points.max(0) + 0.1
        self._cell = float((highest - lowest).max()) / _CELLS
        empty = np.ones(np.ceil((highest - lowest) / self._cell).astype(int) + 1, dtype=bool)
        empty[tuple(((surface.points - lowest) / self._cell).astype(int).T)] = False
        # The outermost cells stand for all that is outside.
        self._distances = np.pad(distance_transform_edt(empty) * self._cell, 1, constant_values=1.0)
        self._lowest = lowest - self._cell
        self._few = few

    def score(self, motions: Motions) -> Float[np.ndarray, " motions"]:
        """Return how much of the cloud each motion carries onto the cloud, 0 to 1."""
        scores = np.empty(len(motions))
        # Single precision is exact to a millionth of the object and takes half the time.
        few, linear = self._few.astype(np.float32), motions.linear.astype(np.float32)
        offset = (motions.shifts - self._lowest).astype(np.float32)
        for start in range(0, len(motions), 2000):
            part = slice(start, start + 2000)
            turned = few @ linear[part].transpose(0, 2, 1) + offset[part, None]
            cells = np.clip((turned / np.float32(self._cell)).astype(np.int32), 0, np.array(self._distances.shape) - 1)
            distance = self._distances[cells[..., 0], cells[..., 1], cells[..., 2]]
            scores[part] = np.exp(-((distance / _COARSE_DISTANCE) ** 2)).mean(axis=1)
        return scores

    def best(self, lines: Lines, most: int, sign: float) -> Lines:
        """Return the axes of half turns (sign 1) or planes of reflections (-1) with the best scores that differ."""
        directions, points = lines
        rows = np.argsort(-self.score(Motions.about(points, -sign * reflections(directions))))[: 60 * most]
        return distinct((directions[rows], points[rows]), most)


def principal_lines(surface: Neighborhoods) -> Lines:
    """Return the principal axes of the surface through its mean, its box's middle and its median."""
    areas = np.minimum(surface.spacing**2, 4 * np.median(surface.spacing**2))
    mean = (areas[:, None] * surface.points).sum(0) / areas.sum()
    centered = surface.points - mean
    _, axes = np.linalg.eigh((areas[:, None] * centered).T @ centered)
    along = surface.points @ axes
    centers = [mean, axes @ ((along.min(0) + along.max(0)) / 2), axes @ np.median(along, axis=0)]
    return np.repeat(axes.T, 3, axis=0), np.tile(centers, (3, 1))


def mirrors_of_pairs(surface: Neighborhoods, pairs: Pairs) -> Lines:
    """Return normals and points of planes that mirror one point of a pair onto the other, with its normal."""
    start, end = (surface.points[rows] for rows in pairs)
    before, after = (surface.normals[rows] for rows in pairs)
    direction = (end - start) / np.linalg.norm(end - start, axis=1)[:, None]
    fits = np.abs(_dot(2 * _dot(before, direction)[:, None] * direction - before, after)) > _MIN_COSINE
    return direction[fits], ((start + end) / 2)[fits]


def half_turns_of_pairs(surface: Neighborhoods, pairs: Pairs) -> Lines:
    """Return axes, and points of them, of half turns of one point of a pair onto the other, with its normal."""
    start, end = (surface.points[rows] for rows in pairs)
    before = surface.normals[pairs[0]]
    directions, points = [], []
    # Normals are of either sign.
    for after in (surface.normals[pairs[1]], -surface.normals[pairs[1]]):
        # A turn changes nothing along its axis: neither the normal nor the place.
        axis = np.cross(after - before, end - start)
        size = np.linalg.norm(axis, axis=1)
        parallel = np.linalg.norm(after - before, axis=1) < 0.2
        axis = np.where(parallel[:, None], before, axis / np.maximum(size, 1e-12)[:, None])
        fits = _dot(2 * _dot(before, axis)[:, None] * axis - before, after) > _MIN_COSINE
        fits &= parallel | (size > 0.2 * np.linalg.norm(end - start, axis=1))
        directions.append(axis[fits])
        points.append(((start + end) / 2)[fits])
    return np.concatenate(directions), np.concatenate(points)


def distinct(lines: Lines, most: int) -> Lines:
    """Return the first lines whose half turns differ from those before them."""
    directions, points = lines
    flips = Motions.about(points, -reflections(directions))
    chosen: list[int] = []
    left = np.ones(len(flips), dtype=bool)
    while left.any() and len(chosen) < most:
        chosen.append(int(left.argmax()))
        left &= flips.distances(flips[chosen[-1]]) >= _SAME_DISTANCE
    return directions[chosen], points[chosen]


def matching_pairs(surface: Neighborhoods, random: np.random.Generator) -> Pairs:
    """Return indices of points that are far from one another and about which the surface is alike."""
    rows = draw_by_area(surface, _DESCRIBED, random)
    counted = random.choice(len(surface.points), min(_COUNTED, len(surface.points)), replace=False)
    described = describe_neighborhoods(surface, rows, counted, diagonal=1.0)
    squares = (described**2).sum(axis=1)
    unlike = squares[:, None] + squares - 2 * described @ described.T
    places = surface.points[rows]
    unlike[((places[:, None] - places) ** 2).sum(axis=2) < 0.1**2] = np.inf
    partners = np.argpartition(unlike, _PARTNERS, axis=1)[:, :_PARTNERS]
    first = np.repeat(np.arange(len(rows)), _PARTNERS)
    second = partners.ravel()
    finite = np.isfinite(unlike[first, second])
    return rows[first[finite]], rows[second[finite]]


def _dot(one: Points, other: Points) -> Float[np.ndarray, " points"]:
    return np.einsum("ni,ni->n", one, other)
