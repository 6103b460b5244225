"""Rotations and reflections of space, as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

_RADIUS = 0.3
"""Root mean square distance of an object's points from their middle, in its diagonals: of a box of equal sides."""
_MIN_SINGULAR_VALUE = 0.15
"""Of the equations for a common point, to the largest: what nearly parallel planes say of where they cross is left."""

Vector = Float[np.ndarray, " 3"]
Points = Float[np.ndarray, "points 3"]
Matrices = Float[np.ndarray, "motions 3 3"]


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions x -> L x + t, each with a fixed point; lengths in diagonals of the object, whose middle is the origin."""

    linear: Matrices
    """Orthogonal matrices L."""
    shifts: Float[np.ndarray, "motions 3"]
    """Vectors t."""

    @classmethod
    def about(cls, centers: Float[np.ndarray, "#motions 3"] | Vector, linear: Matrices) -> "Motions":
        """Return motions about fixed points."""
        return cls(linear, ((np.eye(3) - linear) @ np.broadcast_to(centers, (len(linear), 3))[..., None])[..., 0])

    @classmethod
    def joined(cls, parts: Sequence["Motions"]) -> "Motions":
        """Return all motions of several sets."""
        return cls(np.concatenate([each.linear for each in parts]), np.concatenate([each.shifts for each in parts]))

    def __len__(self) -> int:
        return len(self.linear)

    def __getitem__(self, row: int | np.integer) -> "Motions":
        """Return one of the motions, as a set of one."""
        return Motions(self.linear[row : row + 1], self.shifts[row : row + 1])

    def apply(self, points: Float[np.ndarray, "#motions points 3"]) -> Float[np.ndarray, "motions points 3"]:
        """Return where each motion carries its points, or all of them the same."""
        return points @ self.linear.transpose(0, 2, 1) + self.shifts[:, None]

    def displaced(self, turn: Vector, shift: Vector) -> "Motions":
        """Return the motions as they are after space is turned about the origin (rotation vector) and then shifted."""
        rotation = Rotation.from_rotvec(turn).as_matrix()
        linear = rotation @ self.linear @ rotation.T
        return Motions(linear, self.shifts @ rotation.T + shift - linear @ shift)

    def center(self) -> Vector:
        """Return the point that all of these motions move least; of several the one nearest to the origin."""
        moves = (np.eye(3) - self.linear).reshape(-1, 3)
        return np.linalg.lstsq(moves, self.shifts.ravel(), rcond=_MIN_SINGULAR_VALUE)[0]

    def distances(self, other: "Motions") -> Float[np.ndarray, " motions"]:
        """Return the root mean square distance between where each of these, and one other motion, carry an object."""
        turned = ((self.linear - other.linear) ** 2).sum((1, 2))
        return np.sqrt(_RADIUS**2 / 3 * turned + ((self.shifts - other.shifts) ** 2).sum(1))


def reflections(normals: Points) -> Matrices:
    """Return the reflections in planes through the origin with these unit normals."""
    return np.eye(3) - 2 * normals[:, :, None] * normals[:, None, :]


def rotations(axis: Vector, angles: Sequence[float]) -> Matrices:
    """Return the rotations about an axis through the origin by these angles, radians."""
    return Rotation.from_rotvec(np.outer(angles, axis)).as_matrix()


def axis_of(rotation: Float[np.ndarray, "3 3"]) -> Vector:
    """Return the unit vector along a rotation's axis."""
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return vector / np.linalg.norm(vector)
