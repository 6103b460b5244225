"""How well motions carry a cloud onto itself, and where they do so best.

The cloud is divided at random into four parts, and a motion is scored by how it carries points of each onto the surface
that the others sample. A symmetry does that as well as leaving the points where they are: what noise and uneven cover
do to distances, they do to both, and it is taken away.
"""

import math

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from avmsf.mesh.neighborhoods import NEIGHBORS, Neighborhoods, read_neighborhoods
from avmsf.symmetry.motions import Motions, Points

TOLERANCE = 0.38
"""Largest error of a symmetry, in point spacings; see `find_symmetries`. Chosen, as is the next, on the shapes of the
benchmark of symmetries."""
_MAX_RATIO = 1.15
"""Largest error of one motion of a group, to that of a group."""
_MIN_SPACING, _MAX_SPACING = 0.01, 0.016
"""Bounds of the spacing that errors are measured in, in diagonals: things are not made, nor scanned, more exactly than
the first lets pass, and what is off by more than the second lets pass is so however few points there are."""
_MAX_DISTANCE = 3.0
"""Distance in spacings from which on a point has no counterpart; counted distances end here."""
_PARTS, _QUERIES = 4, 1500
"""Parts of the cloud, and most points that are moved."""
_MIN_QUERIES = 60
"""Least number of points by which one motion of a group is fitted."""
_SMALL_STEP = 1e-3
"""Of a fit: radians or diagonals."""
_TEST_SHIFT, _MIN_SHIFT_ERROR = 0.1, 3.0
"""A shift in diagonals, and the error that it must have for points to show a surface, in tolerances: 600 to 2000 points
that fill a box have at most 1.2, 300 to 8000 of the benchmark's shapes 3.5 and more."""
_MAX_PATCH = 1 / 80
"""A plane stands for at most this part of a surface, unless it had fewer points than the first of these:"""
_NEIGHBORS, _MOVED_NEIGHBORS = (8, NEIGHBORS), (3, 8)
"""Least and largest number of points of a plane. Points of the sparser part that is moved go into planes of as large
patches, or stay where they are: three points lie in their plane."""


class SymmetryTest:
    """A cloud in parts, each of which is moved to the surface that the others sample; lengths in its diagonals."""

    surface: Neighborhoods
    """That of all points, on which motions are fitted."""
    queries: Points
    """Points of it, drawn evenly by area."""
    spacing: float
    """Median spacing of the other parts within its bounds: the unit of errors."""
    noise: float
    """Mean square distance of points that are not moved, in spacings squared."""
    noise_error: float
    """Standard error of `noise`."""
    tolerance: float
    """Largest error of a symmetry; 0 where the points show no surface, or where the standard error of `noise` is above
    its square, and chance decides."""

    def __init__(self, points: Points, generator: np.random.Generator) -> None:
        self.surface = local_planes(points)
        self.queries = self.surface.points[draw_by_area(self.surface, _QUERIES, generator)]
        self._tree = cKDTree(self.surface.points)
        part = generator.permutation(len(points)) % _PARTS
        self._parts = []
        for number in range(_PARTS):
            moved, target = local_planes(points[part == number], _MOVED_NEIGHBORS), local_planes(points[part != number])
            queries = moved.points[draw_by_area(moved, _QUERIES // _PARTS, generator)]
            self._parts.append((queries, target, cKDTree(target.points)))
        spacing = np.median([np.median(target.spacing) for _, target, _ in self._parts])
        self.spacing = float(np.clip(spacing, _MIN_SPACING, _MAX_SPACING))
        unmoved = self._squared_distances(Motions.about(np.zeros(3), np.eye(3)[None]))[0]
        self.noise = float(unmoved.mean())
        self.noise_error = float(unmoved.std()) / math.sqrt(len(unmoved))
        # A shift is never a symmetry of what is bounded: where it is not seen, points fill a volume, or noise does.
        shifts = Motions(np.tile(np.eye(3), (6, 1, 1)), _TEST_SHIFT * np.concatenate([np.eye(3), -np.eye(3)]))
        seen = self.squared_errors(shifts).mean() > (_MIN_SHIFT_ERROR * TOLERANCE) ** 2
        self.tolerance = TOLERANCE if seen and self.noise_error < TOLERANCE**2 else 0.0

    def squared_errors(self, motions: Motions) -> Float[np.ndarray, " motions"]:
        """Return each motion's mean square distance of moved points less what noise alone makes, in spacings squared.

        Chance makes that of a symmetry negative as often as positive.
        """
        return self._squared_distances(motions).mean(1) - self.noise

    def holds(self, squares: Float[np.ndarray, " motions"]) -> bool:
        """Return whether motions with these squared errors are symmetries: on average and, but for chance, each."""
        largest = (_MAX_RATIO * self.tolerance) ** 2 + 2.0 * self.noise_error
        return bool(squares.mean() <= self.tolerance**2 and squares.max() <= largest)

    def _squared_distances(self, motions: Motions) -> Float[np.ndarray, "motions points"]:
        """Return squared distances along the surface's normals, as nothing marks a position within a surface."""
        parts = []
        for queries, target, tree in self._parts:
            moved = motions.apply(queries[None])
            distance, index = tree.query(moved)
            normal = np.abs(np.einsum("mni,mni->mn", moved - target.points[index], target.normals[index]))
            lost = distance > _MAX_DISTANCE * np.maximum(target.spacing[index], self.spacing)
            parts.append(np.where(lost, _MAX_DISTANCE, np.minimum(normal / self.spacing, _MAX_DISTANCE)) ** 2)
        return np.concatenate(parts, axis=1)

    def refine(self, motion: Motions) -> tuple[Motions, float]:
        """Return one motion moved to where it holds best, and its squared error.

        First roughly and, where that promises something, finely.
        """
        fitted = self.fit(motion, queries=300, steps=14)
        rough = fitted, float(self.squared_errors(fitted)[0])
        if rough[1] >= (4 * self.tolerance) ** 2:
            return rough
        fitted = self.fit(fitted, queries=1500, steps=5, width=0.01)
        return min(rough, (fitted, float(self.squared_errors(fitted)[0])), key=lambda each: each[1])

    def fit(self, motions: Motions, *, queries: int = 4000, steps: int = 60, width: float = 0.05) -> Motions:
        """Return motions moved together to where they carry points nearest to the surface.

        Gauss-Newton on the distances along the surface's normals: turning space by w about the origin and shifting it
        by v moves the image q = L p + t of p by w x q + v - L (w x p + v). The `queries` are shared by the motions.
        Distances are weighted down (Geman and McClure) beyond a width that is halved, down to half a spacing, once a
        step is small, so that one-sided parts lose their pull.
        """
        share = min(max(queries // len(motions), _MIN_QUERIES), len(self.queries))
        points = self.queries[np.arange(share * len(motions)).reshape(-1, share) % len(self.queries)]
        for _ in range(steps):
            image = motions.apply(points)
            distance, index = self._tree.query(image, distance_upper_bound=3 * width + 3 * self.spacing)
            weights = (width**2 / (width**2 + distance**2)) ** 2
            index = np.where(np.isfinite(distance), index, 0)
            normal = self.surface.normals[index]
            residual = np.einsum("mni,mni->mn", image - self.surface.points[index], normal)
            back = normal @ motions.linear
            slopes = np.concatenate([np.cross(image, normal) - np.cross(points, back), normal - back], axis=2)
            slopes, weighted = slopes.reshape(-1, 6), (weights[..., None] * slopes).reshape(-1, 6)
            left, right = weighted.T @ slopes, -weighted.T @ residual.ravel()
            # Turning a plane within itself or an axis about itself changes nothing: those directions stay unmoved.
            values, vectors = np.linalg.eigh(left)
            kept = values > 1e-4 * values[-1]
            step = vectors[:, kept] @ ((vectors[:, kept].T @ right) / values[kept])
            length = float(np.linalg.norm(step))
            motions = motions.displaced(*np.split(step * min(1.0, 0.15 / max(length, 1e-12)), 2))
            if length < _SMALL_STEP:
                if width <= 0.5 * self.spacing:
                    break
                width = max(0.5 * width, 0.5 * self.spacing)
        return motions


def local_planes(points: Points, neighbors: tuple[int, int] = _NEIGHBORS) -> Neighborhoods:
    """Return the surface about the points of a cloud, by planes through few enough of them for what it resolves."""
    return read_neighborhoods(points, count=int(np.clip(_MAX_PATCH * len(points), *neighbors)))


def draw_by_area(
    surface: Neighborhoods, count: int, generator: np.random.Generator, *, max_ratio: float = 4.0
) -> Int[np.ndarray, " drawn"]:
    """Return the indices of at most `count` points, drawn by the area that falls to each.

    Some points in a cloud lie alone, and would stand for much more than they show: an area counts up to `max_ratio`
    times the median.
    """
    areas = surface.spacing**2
    areas = np.minimum(areas, max_ratio * np.median(areas))
    return generator.choice(len(areas), min(count, len(areas)), replace=False, p=areas / areas.sum())
