"""How well a motion carries a cloud onto itself, and where it does so best.

The cloud is divided at random into two halves, and a motion is scored by how it carries points of the one onto the
surface that the other one samples. A symmetry does that as well as leaving the points where they are: what noise and
uneven cover do to distances, they do to both, and it is taken away.
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from avmsf.gaussians.neighborhoods import NEIGHBORS, Neighborhoods, read_neighborhoods
from avmsf.symmetry.motion import Motion

TOLERANCE = 0.38
"""Largest error of a symmetry, in point spacings, where the points are dense; see `find_symmetries`."""
_MIN_SPACING, _MAX_SPACING = 0.01, 0.016
"""Bounds of the spacing that errors are measured in, in diagonals: things are not made, nor scanned, more exactly than
the first lets pass, and what is off by more than the second lets pass is so however few points there are."""
_MAX_DISTANCE = 3.0
"""Distance in spacings from which on a point has no counterpart; counted distances end here."""
_QUERIES = 1500
_MIN_NEIGHBORS, _MAX_PATCH = 8, 1 / 80
"""A plane stands for at most this part of a surface, unless it had fewer points than the first."""

Points = Float[np.ndarray, "points 3"]


class SymmetryTest:
    """A cloud in two halves, points to be moved and a surface that they should meet; lengths in its diagonals."""

    queries: Points
    """Of one half, drawn evenly by area."""
    target: Neighborhoods
    spacing: float
    """Median spacing of the target within its bounds: the unit of errors."""
    noise: float
    """Mean square distance of queries that are not moved, in spacings squared."""
    tolerance: float
    """Largest error of a symmetry. Its square is less by two standard errors of `noise`, which a wrong motion may gain
    by chance; 0 where nothing is left, as no motion can then be told from a symmetry."""

    def __init__(self, points: Points, generator: np.random.Generator) -> None:
        order = generator.permutation(len(points))
        moved, self.target = (read_surface(points[order[part::2]]) for part in (0, 1))
        self.queries = moved.points[draw_by_area(moved, _QUERIES, generator)]
        self.spacing = float(np.clip(np.median(self.target.spacing), _MIN_SPACING, _MAX_SPACING))
        self._tree = cKDTree(self.target.points)
        unmoved = self._squared_distances(self.queries)
        self.noise = float(unmoved.mean())
        chance = 2.0 * float(unmoved.std()) / math.sqrt(len(unmoved))
        self.tolerance = math.sqrt(max(TOLERANCE**2 - chance, 0.0))

    def error(self, motion: Motion) -> float:
        """Return the root mean square distance of moved points, without what noise alone makes, in spacings."""
        squares = self._squared_distances(motion.apply(self.queries))
        return math.sqrt(max(float(squares.mean()) - self.noise, 0.0))

    def _squared_distances(self, moved: Points) -> Float[np.ndarray, " points"]:
        """Return squared distances along the surface's normals, as nothing marks a position within a surface."""
        distance, index = self._tree.query(moved)
        normal = np.abs(np.einsum("ni,ni->n", moved - self.target.points[index], self.target.normals[index]))
        lost = distance > _MAX_DISTANCE * np.maximum(self.target.spacing[index], self.spacing)
        return np.where(lost, _MAX_DISTANCE, np.minimum(normal / self.spacing, _MAX_DISTANCE)) ** 2

    def refine(self, motion: Motion, *, width: float) -> Motion:
        """Return a motion moved to where it holds best, first roughly and, where that promises something, finely."""
        fitted = self.fit(motion, queries=300, width=width)
        rough = replace(fitted, error=self.error(fitted))
        if rough.error >= 4 * self.tolerance:
            return rough
        fitted = self.fit(fitted, queries=1500, steps=5, width=0.01)
        return min(rough, replace(fitted, error=self.error(fitted)), key=lambda each: each.error)

    def fit(
        self,
        motion: Motion,
        *,
        angles: tuple[float, ...] = (),
        queries: int = 600,
        steps: int = 14,
        width: float = 0.05,
    ) -> Motion:
        """Return the motion with its plane or axis where moved points lie nearest to the surface.

        Gauss-Newton on the distances along the target's normals: turning the plane or axis by w about the origin and
        shifting it by v moves the image q = L p + t of p by w x q + v - L (w x p + v). Turns are fitted at all `angles`
        together, their own by default. Distances are weighted down (Geman and McClure) beyond a width that shrinks from
        `width` to half a spacing, so that one-sided parts lose their pull.
        """
        least = 0.5 * self.spacing
        for scale in np.geomspace(max(width, least), least, steps):
            left, right = np.zeros((6, 6)), np.zeros(6)
            for angle in angles or (motion.angle,):
                one_left, one_right = self._normal_equations(
                    replace(motion, angle=angle), self.queries[:queries], float(scale)
                )
                left, right = left + one_left, right + one_right
            # Turning a plane within itself or an axis about itself changes nothing: those directions stay unmoved.
            values, vectors = np.linalg.eigh(left)
            kept = values > 1e-4 * values[-1]
            step = vectors[:, kept] @ ((vectors[:, kept].T @ right) / values[kept])
            step *= min(1.0, 0.15 / max(float(np.linalg.norm(step)), 1e-12))
            motion = motion.shifted(step[:3], step[3:])
        return motion

    def _normal_equations(
        self, motion: Motion, points: Points, scale: float
    ) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, " 6"]]:
        linear, moved = motion.linear, motion.apply(points)
        distance, index = self._tree.query(moved, distance_upper_bound=3 * scale + 3 * self.spacing)
        met = np.isfinite(distance)
        image, source, near = moved[met], points[met], index[met]
        normal = self.target.normals[near]
        residual = np.einsum("ni,ni->n", image - self.target.points[near], normal)
        back = normal @ linear
        slopes = np.c_[np.cross(image, normal) - np.cross(source, back), normal - back]
        weights = (scale**2 / (scale**2 + distance[met] ** 2)) ** 2
        return slopes.T @ (weights[:, None] * slopes), -slopes.T @ (weights * residual)


def read_surface(points: Points) -> Neighborhoods:
    """Return the surface about the points of a cloud, by planes through few enough of them for what it resolves."""
    return read_neighborhoods(points, count=int(np.clip(_MAX_PATCH * len(points), _MIN_NEIGHBORS, NEIGHBORS)))


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
