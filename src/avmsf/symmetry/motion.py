"""Motions of space: reflections in planes and turns about axes, as arrays."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

MAX_ORDER = 12
"""Largest order of an axis that is told from that of any turn."""
SAME_DEGREES, SAME_GAP = 6.0, 0.03
"""Angle and distance, in diagonals of the object, within which two planes or axes that fit are one."""

Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class Motion:
    """A reflection in a plane, or a turn about an axis; as a symmetry it has an order and an error."""

    direction: Vector
    """Unit normal of the plane, or unit vector along the axis; of either sign."""
    point: Vector
    """A point of the plane or axis."""
    angle: float | None
    """Radians; None for a reflection."""
    order: int | None = None
    """Of a turn that is a symmetry: how many make a whole one; None for a plane, and where any angle will do."""
    error: float = math.inf
    """Root mean square distance of moved points from the surface; see `find_symmetries`."""

    @property
    def linear(self) -> Float[np.ndarray, "3 3"]:
        """The motion without its shift."""
        if self.angle is None:
            return np.eye(3) - 2 * np.outer(self.direction, self.direction)
        return Rotation.from_rotvec(self.angle * self.direction).as_matrix()

    @property
    def continuous(self) -> bool:
        """Whether this is an axis about which every angle is a symmetry."""
        return self.angle is not None and self.order is None

    def apply(self, points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Return where the points go."""
        return (points - self.point) @ self.linear.T + self.point

    def shifted(self, turn: Vector, shift: Vector) -> "Motion":
        """Return the motion whose plane or axis is turned about the origin (rotation vector) and then shifted."""
        rotation = Rotation.from_rotvec(turn)
        return replace(self, direction=rotation.apply(self.direction), point=rotation.apply(self.point) + shift)

    def least_turn(self) -> "Motion":
        """Return the least turn of the order of this one; a reflection as it is."""
        return self if self.order is None else replace(self, angle=2 * math.pi / self.order)

    def conjugated_by(self, other: "Motion") -> "Motion":
        """Return the symmetry that follows from this and another one: the other's image of this plane or axis."""
        return replace(self, direction=other.linear @ self.direction, point=other.apply(self.point[None])[0])

    def after(self, other: "Motion") -> "Motion | None":
        """Return the other motion followed by this one; None if it is no reflection, nor a turn of an order."""
        return motion_of(self.linear @ other.linear, self.apply(other.apply(np.zeros((1, 3))))[0])

    def centered(self) -> "Motion":
        """Return the same motion, its point the one nearest to the origin."""
        along = (self.point @ self.direction) * self.direction
        return replace(self, point=along if self.angle is None else self.point - along)

    def is_near(self, other: "Motion", degrees: float = SAME_DEGREES, gap: float = SAME_GAP) -> bool:
        """Return whether two planes or axes differ by less than an angle and by how far apart they pass the origin."""
        cosine = min(1.0, abs(float(self.direction @ other.direction)))
        between = np.linalg.norm(self.centered().point - other.centered().point)
        return math.degrees(math.acos(cosine)) < degrees and bool(between < gap)

    def follows(self, axis: "Motion") -> bool:
        """Return whether this plane contains, or this half turn's axis crosses, an axis that every turn leaves."""
        if self.angle is None:
            crossing = abs(self.direction @ (self.point - axis.point)) < SAME_GAP
        else:
            crossing = abs(abs(self.angle) - math.pi) < 1e-6
        return bool(crossing and abs(self.direction @ axis.direction) < 0.1)


def motion_of(linear: Float[np.ndarray, "3 3"], shift: Vector) -> Motion | None:
    """Return x -> L x + t as a reflection or as the least turn of its order about its axis; None if it is neither."""
    if np.linalg.det(linear) < 0.0:
        _, directions = np.linalg.eigh(linear + linear.T)
        normal = directions[:, 0]
        gliding = shift - (shift @ normal) * normal
        if np.abs(linear - (np.eye(3) - 2 * np.outer(normal, normal))).max() > 0.15 or np.abs(gliding).max() > 0.05:
            return None
        return Motion(normal, (shift @ normal / 2) * normal, None)
    turn = Rotation.from_matrix(linear).as_rotvec()
    angle = float(np.linalg.norm(turn))
    part = Fraction(angle / (2 * math.pi)).limit_denominator(MAX_ORDER)
    if not part or abs(angle - 2 * math.pi * part) >= math.radians(4) or abs(turn @ shift) > 0.05 * angle:
        return None
    point = np.linalg.lstsq(np.eye(3) - linear, shift, rcond=0.05)[0]
    return Motion(turn / angle, point, 2 * math.pi / part.denominator)
