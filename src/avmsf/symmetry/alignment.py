"""Motions of space, how well they carry a cloud onto itself, and where they do so best.

The cloud is divided at random into two halves, and a motion is scored by how it carries points of the one onto the
surface that the other one samples. A symmetry does that as well as leaving the points where they are: what noise and
uneven cover do to distances, they do to both, and it is taken away.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from avmsf.gaussians.neighborhoods import Neighborhoods, read_neighborhoods

_MAX_DISTANCE = 3.0
"""Distance in spacings from which on a point has no counterpart; counted distances end here."""

Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class Motion:
    """A reflection in a plane, or a turn about an axis."""

    direction: Vector
    """Unit normal of the plane, or unit vector along the axis; of either sign."""
    point: Vector
    """A point of the plane or axis."""
    angle: float | None
    """Radians; None for a reflection."""

    @property
    def linear(self) -> Float[np.ndarray, "3 3"]:
        """The motion without its shift."""
        if self.angle is None:
            return np.eye(3) - 2 * np.outer(self.direction, self.direction)
        return Rotation.from_rotvec(self.angle * self.direction).as_matrix()

    def apply(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Return where the points go."""
        return (points - self.point) @ self.linear.T + self.point

    def shifted(self, turn: Vector, shift: Vector) -> "Motion":
        """Return the motion whose plane or axis is turned about the origin (rotation vector) and then shifted."""
        carried = Rotation.from_rotvec(turn)
        return replace(self, direction=carried.apply(self.direction), point=carried.apply(self.point) + shift)

    def with_angle(self, angle: float) -> "Motion":
        """Return a turn about the same axis by another angle."""
        return replace(self, angle=angle)

    def conjugated_by(self, other: "Motion") -> "Motion":
        """Return the symmetry that follows from this and another one: the other's image of this plane or axis."""
        return replace(self, direction=other.linear @ self.direction, point=other.apply(self.point[None])[0])

    def centered(self) -> "Motion":
        """Return the same motion, its point the one nearest to the origin."""
        along = (self.point @ self.direction) * self.direction
        return replace(self, point=along if self.angle is None else self.point - along)

    def separation(self, other: "Motion") -> tuple[float, float]:
        """Return the angle between two planes or axes, degrees, and how far apart they pass the origin."""
        cosine = min(1.0, abs(float(self.direction @ other.direction)))
        gap = self.centered().point - other.centered().point
        return math.degrees(math.acos(cosine)), float(np.linalg.norm(gap))


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
        chosen = draw_by_area(moved, count, generator)
        spacing = float(np.clip(np.median(target.spacing), *bounds))
        halves = cls(moved.points[chosen], target, cKDTree(target.points), spacing, noise=0.0)
        return replace(halves, noise=halves.mean_square_distance(halves.queries))

    def mean_square_distance(self, moved: Float[np.ndarray, "queries 3"]) -> float:
        """Return the mean square distance to the surface in spacings squared, distances counted up to 3 spacings.

        Where there is a counterpart the distance is taken along the normal, since nothing marks a position within a
        surface.
        """
        distance, index = self.tree.query(moved)
        normal = np.abs(np.einsum("ni,ni->n", moved - self.target.points[index], self.target.normals[index]))
        lost = distance > _MAX_DISTANCE * np.maximum(self.target.spacing[index], self.spacing)
        counted = np.where(lost, _MAX_DISTANCE, np.minimum(normal / self.spacing, _MAX_DISTANCE))
        return float((counted**2).mean())

    def error(self, motion: Motion) -> float:
        """Return the root mean square distance of moved points, without what noise alone makes, in spacings."""
        return math.sqrt(max(self.mean_square_distance(motion.apply(self.queries)) - self.noise, 0.0))


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


def fit_motion(
    motion: Motion,
    halves: Halves,
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
    points = halves.queries[:queries]
    turns = [motion.angle] if motion.angle is None or not angles else list(angles)
    least = 0.5 * halves.spacing
    scales: list[float] = np.geomspace(max(width, least), least, steps).tolist()
    for scale in scales:
        left, right = np.zeros((6, 6)), np.zeros(6)
        for angle in turns:
            moved_by = Motion(motion.direction, motion.point, angle)
            linear, moved = moved_by.linear, moved_by.apply(points)
            distance, index = halves.tree.query(moved, distance_upper_bound=3 * scale + 3 * halves.spacing)
            met = np.isfinite(distance)
            image, source, near = moved[met], points[met], index[met]
            normal = halves.target.normals[near]
            residual = np.einsum("ni,ni->n", image - halves.target.points[near], normal)
            back = normal @ linear
            slopes = np.c_[np.cross(image, normal) - np.cross(source, back), normal - back]
            weights = (scale**2 / (scale**2 + distance[met] ** 2)) ** 2
            left += slopes.T @ (weights[:, None] * slopes)
            right -= slopes.T @ (weights * residual)
        # Turning a plane within itself or an axis about itself changes nothing: those directions stay unmoved.
        values, vectors = np.linalg.eigh(left)
        kept = values > 1e-4 * values[-1]
        step = vectors[:, kept] @ ((vectors[:, kept].T @ right) / values[kept])
        length = float(np.linalg.norm(step))
        step *= min(1.0, 0.15 / max(length, 1e-12))
        motion = motion.shifted(step[:3], step[3:])
    return motion
