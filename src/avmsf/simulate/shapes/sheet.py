"""A wall: triangles on its middle, and how far it reaches to both sides of them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int

_SHARPEST = 0.4
"""Least mean of the cosines between the normal at a corner and the faces around it that a mitre is made for."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """Triangles on the middle of a wall."""

    middle: Float64[np.ndarray, "points 3"]
    """Meters."""
    offsets: Float64[np.ndarray, "points 3"]
    """From the middle to the upper side of the wall, the side from which triangles are counter-clockwise."""
    triangles: Int[np.ndarray, "triangles 3"]
    """Rows of `middle`."""
    order: Int[np.ndarray, " points"]
    """Numbers that differ along every edge; they decide how the wall is cut into tetrahedra."""

    @classmethod
    def of(
        cls,
        middle: Float64[np.ndarray, "points 3"],
        walls: Float64[np.ndarray, " points"],
        triangles: Int[np.ndarray, "triangles 3"],
        order: Int[np.ndarray, " points"],
    ) -> "Sheet":
        """Return the sheet whose thickness at each point is `walls`, measured across the triangles, meters."""
        return cls(middle, 0.5 * walls[:, None] * mitred_normals(middle, triangles), triangles, order)


def mitred_normals(
    points: Float64[np.ndarray, "points 3"], triangles: Int[np.ndarray, "triangles 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Return a vector at each point that, added to all, moves the triangles around it by 1 along their normals.

    Its direction is the mean of their normals weighted by their angles at the point, which does not depend on how
    a plane is cut into triangles; it is longer than 1 where they form an edge or a corner.
    """
    corners = points[triangles]
    flat = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    sides = _unit(np.roll(corners, -1, axis=1) - corners)
    angles = np.arccos(np.clip(-(sides * np.roll(sides, 1, axis=1)).sum(axis=-1), -1, 1))
    count = len(points)

    def gather(values: np.ndarray) -> np.ndarray:
        return np.bincount(triangles.ravel(), weights=values.ravel(), minlength=count)

    total = np.stack([gather(angles * flat[:, axis, None]) for axis in range(3)], axis=1)
    normals = _unit(total)
    cosines = gather(angles * (normals[triangles] * flat[:, None]).sum(axis=-1)) / np.maximum(gather(angles), 1e-300)
    return normals / np.maximum(cosines, _SHARPEST)[:, None]


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
