"""Candidates for a symmetry: reflections and turns of space, moved about and compared."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

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

    def turning(self, angle: float) -> "Motion":
        """Return a turn about the same axis by another angle."""
        return replace(self, angle=angle)

    def under(self, other: "Motion") -> "Motion":
        """Return the symmetry that follows from this and another one: the other's image of this plane or axis."""
        return replace(self, direction=other.linear @ self.direction, point=other.apply(self.point[None])[0])

    def centered(self, middle: Vector) -> "Motion":
        """Return the same motion, its point the one nearest to `middle`."""
        offset = middle - self.point
        along = (offset @ self.direction) * self.direction
        return replace(self, point=middle - along if self.angle is None else self.point + along)

    def apart(self, other: "Motion", middle: Vector) -> tuple[float, float]:
        """Return the angle between two planes or axes, degrees, and how far apart they pass the `middle`."""
        cosine = min(1.0, abs(float(self.direction @ other.direction)))
        gap = self.centered(middle).point - other.centered(middle).point
        return math.degrees(math.acos(cosine)), float(np.linalg.norm(gap))
