"""A visual hull drawn taut: where no outline touches it, it is as small as what does allows.

Cameras that stand below a flat top see its near edge against the sky, so that the hull bears a low roof over it. Every
line of sight along an outline touches the object somewhere; it is taken to do so where the hull is bent most, and
between these places the surface is that of a stretched membrane.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Bool, Float32, Float64, Int
from scipy import ndimage

from avmsf.geometry.grid import Grid
from avmsf.geometry.shape import closed_surface
from avmsf.geometry.silhouettes import Outline

_ROUND = 0.015
"""Standard deviation of the ball in which the hull's part says how bent it is, over the diagonal."""
_TOUCHING = 0.75
"""Distance from an outline, pixels, within which a place is on it."""
_EVEN = 0.03
"""Difference in the hull's part of a ball up to which two places are bent alike: half a ball is .5, an edge .25."""
_HELD = 1e-3
"""Weight of where the hull was, beside the membrane's: parts that no outline touches stay about where they are."""

_ROUNDS = 300
"""Most steps of the conjugate gradients that stretch the membrane."""


def drawn_taut(
    hull: Float32[np.ndarray, "x y z"], outlines: Sequence[Outline], grid: Grid, diagonal: float
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return how far inside the taut hull each cell lies, meters, and how far from any outline's touch it lies."""
    surface = closed_surface(hull, grid)
    places, faces = surface.vertices.double().numpy(), surface.faces.numpy()
    full = ndimage.gaussian_filter((hull > 0).astype(np.float32), _ROUND * diagonal / grid.spacing)
    bent = ndimage.map_coordinates(full, ((places - grid.lowest) / grid.spacing).T, order=1)
    touched = np.zeros(len(places), dtype=bool)
    for each in outlines:
        touched[_touching(each, places, bent)] = True
    if not touched.any():
        return hull, np.full(grid.shape, diagonal, dtype=np.float32)
    drawn = _membrane(places, faces, touched)
    inward = np.maximum(((places - drawn) * _normals(places, faces)).sum(axis=1), 0.0)
    fall = np.zeros(grid.shape, dtype=np.float32)
    cells = tuple(np.rint((places - grid.lowest) / grid.spacing).astype(int).T)
    np.maximum.at(fall, cells, inward.astype(np.float32))
    far = np.ones(grid.shape, dtype=bool)
    far[cells] = False
    nearest = ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
    fall = fall[tuple(nearest)]
    # A flat roof is lowered as it is; far below it nothing changes.
    taut = np.where((hull > 0) & (hull < 2.0 * (fall + grid.spacing)), hull - fall, hull)
    away = np.ones(grid.shape, dtype=bool)
    away[tuple(each[touched] for each in cells)] = False
    return taut, ndimage.distance_transform_edt(away).astype(np.float32) * np.float32(grid.spacing)


def _touching(outline: Outline, places: Float64[np.ndarray, "places 3"], bent: np.ndarray) -> Int[np.ndarray, " found"]:
    """Return, for each line of sight along an outline, where on it the hull is bent most."""
    seen = places @ outline.projection[:, :3].T + outline.projection[:, 3]
    pixels = seen[:, :2] / np.maximum(seen[:, 2:], 1e-12)
    height, width = outline.inside.shape
    inside = (seen[:, 2] > 0) & (pixels > 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    rows = np.flatnonzero(inside)
    apart = ndimage.map_coordinates(outline.inside, pixels[rows, ::-1].T - 0.5, order=1, mode="nearest")
    rows = rows[np.abs(apart) < _TOUCHING]
    column, row = pixels[rows].astype(int).T
    least = np.ones((height, width))
    np.minimum.at(least, (row, column), bent[rows])
    # Lines of sight through neighboring pixels touch in the same place.
    return rows[bent[rows] <= ndimage.minimum_filter(least, 3)[row, column] + _EVEN]


def _membrane(
    places: Float64[np.ndarray, "places 3"], faces: Int[np.ndarray, "faces 3"], fixed: Bool[np.ndarray, " places"]
) -> Float64[np.ndarray, "places 3"]:
    """Return where the vertices of a stretched membrane lie that is fixed at some."""
    ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = len(places)
    links = scipy.sparse.csr_array((np.ones(len(ends)), ends.T), shape=(count, count))
    links = links.maximum(links.T)
    pull = scipy.sparse.dia_array((np.asarray(links.sum(axis=0))[None], [0]), shape=(count, count)).tocsr() - links
    free = np.flatnonzero(~fixed)
    matrix = pull[free][:, free] + _HELD * scipy.sparse.eye_array(len(free), format="csr")
    right = _HELD * places[free] - pull[free][:, np.flatnonzero(fixed)] @ places[fixed]
    scale = scipy.sparse.dia_array((1.0 / matrix.diagonal()[None], [0]), shape=matrix.shape)
    drawn = places.copy()
    for axis in range(3):
        drawn[free, axis] = scipy.sparse.linalg.cg(
            matrix, right[:, axis], x0=places[free, axis], rtol=1e-5, maxiter=_ROUNDS, M=scale
        )[0]
    return drawn


def _normals(
    places: Float64[np.ndarray, "places 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "places 3"]:
    corners = places[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(places)
    for corner in range(3):
        np.add.at(total, faces[:, corner], across)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
