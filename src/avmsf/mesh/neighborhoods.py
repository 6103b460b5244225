"""What the surface is like about the points of a cloud: its normals and spacing, and shape descriptors.

A cloud knows no faces. A plane through a point's nearest points stands for the surface there, so that the normals have
no side, and what is smaller than such a neighborhood is smoothed away. Nothing here depends on the object's pose.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

NEIGHBORS = 24
"""Points that a plane is laid through: few enough for detail, enough to average noise away."""
_RADIUS_RATIOS = (0.08, 0.16, 0.28)
"""Radii in which descriptors see the surface, in diagonals of the object."""


@dataclass(frozen=True, eq=False)
class Neighborhoods:
    """Points of a cloud with the surface about each."""

    points: Float[np.ndarray, "points 3"]
    """Moved along the normals into the planes of their neighbors, which takes most of the noise away."""
    normals: Float[np.ndarray, "points 3"]
    """Unit normals, of either sign."""
    spacing: Float[np.ndarray, " points"]
    """Side of the square of surface that falls to one point, in the unit of the points."""


def read_neighborhoods(points: Float[np.ndarray, "points 3"], *, count: int = NEIGHBORS) -> Neighborhoods:
    """Lay a plane through every point's `count` nearest points, itself among them."""
    distances, rows = cKDTree(points).query(points, k=min(count, len(points)))
    offsets = points[rows] - points[:, None]
    means = offsets.mean(axis=1)
    centered = offsets - means[:, None]
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", centered, centered))
    normals = directions[:, :, 0]
    along = np.einsum("ni,ni->n", means, normals)[:, None] * normals
    # A disc of surface holds the neighbors: its area divided among them is what falls to each.
    spacing = distances[:, -1] * np.sqrt(np.pi / offsets.shape[1])
    return Neighborhoods(points + along, normals, spacing)


def describe_neighborhoods(
    surface: Neighborhoods, rows: Int[np.ndarray, " rows"], others: Int[np.ndarray, " others"], *, diagonal: float
) -> Float[np.ndarray, "rows dim"]:
    """Return numbers that are alike where the surface is alike, whichever way it is turned or mirrored.

    In balls of three radii: how much surface there is, the eigenvalues of its covariance, and how far its mean lies
    along and across the normal. In the largest ball also a histogram over the distance from the normal's line and the
    distance from the tangent plane (after the spin images of Johnson and Hebert 1999, without sides). `others` are the
    points that are counted, each with the area that falls to it, so that uneven cover does not show. Every number is
    scaled to its spread over `rows`.
    """
    centers, normals = surface.points[rows], surface.normals[rows]
    cloud, areas = surface.points[others], surface.spacing[others] ** 2
    products = cloud[:, :, None] * cloud[:, None, :]
    squares = ((centers[:, None] - cloud) ** 2).sum(axis=2)
    columns: list[Float[np.ndarray, "rows any"]] = []
    for radius in diagonal * np.asarray(_RADIUS_RATIOS):
        weights = areas * (squares <= radius**2)
        # Far from all counted points there is nothing to describe; a trace of weight keeps the division defined.
        total = weights.sum(axis=1) + 1e-9 * areas.mean()
        means = weights @ cloud / total[:, None]
        second = (weights @ products.reshape(-1, 9) / total[:, None]).reshape(-1, 3, 3)
        spread = np.linalg.eigvalsh(second - means[:, :, None] * means[:, None, :])
        offset = means - centers
        along = np.abs(np.einsum("ni,ni->n", offset, normals))
        across = np.sqrt(np.maximum((offset**2).sum(axis=1) - along**2, 0.0))
        scaled = np.sqrt(np.maximum(spread, 0.0)) / radius
        columns.append(np.c_[total / radius**2, scaled, along / radius, across / radius])
    columns.append(_spin_images(centers, normals, cloud, areas, squares, radius=diagonal * _RADIUS_RATIOS[-1]))
    described = np.concatenate(columns, axis=1)
    deviation = np.abs(described - np.median(described, axis=0)).mean(axis=0)
    return (described - np.median(described, axis=0)) / np.maximum(deviation, 0.02 * np.abs(described).max())


def _spin_images(
    centers: Float[np.ndarray, "rows 3"],
    normals: Float[np.ndarray, "rows 3"],
    cloud: Float[np.ndarray, "others 3"],
    areas: Float[np.ndarray, " others"],
    squares: Float[np.ndarray, "rows others"],
    *,
    radius: float,
) -> Float[np.ndarray, "rows bins"]:
    heights = np.abs(normals @ cloud.T - np.einsum("ni,ni->n", centers, normals)[:, None])
    across = np.sqrt(np.maximum(squares - heights**2, 0.0))
    near: Bool[np.ndarray, "rows others"] = squares <= radius**2
    place = np.minimum((4 * across / radius).astype(int), 3) + 4 * np.minimum((4 * heights / radius).astype(int), 3)
    return np.stack([(areas * (near & (place == bin_))).sum(axis=1) for bin_ in range(16)], axis=1) / radius**2
