"""A visual hull made smaller where no outline touches it: the surface there is a stretched membrane.

Cameras below a flat top see only its near edge, so that the hull has a low pyramid above it. Every line of sight along
an outline touches the object somewhere. It is assumed to do so where many other outlines pass as well, which meet at
edges of the object but hardly on a pyramid, and of these points where the hull is bent most. Between these points the
surface is a membrane that is fixed at them.
"""

from collections.abc import Sequence

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import trimesh
from jaxtyping import Bool, Float32, Float64, Int
from scipy import ndimage

from avmsf.mesh.level_set import Grid, enclose
from avmsf.reconstruction.outlines import Outline

_BLUR_RATIO = 0.015
"""Standard deviation of the Gaussian blur of the hull that measures how bent its surface is, over the diagonal."""
_TOUCH_PIXELS = 0.75
"""Distance from an outline, pixels, within which a point is on it."""
_BEND_TOLERANCE = 0.03
"""Difference of the blurred hull up to which two points are equally bent: a plane has .5, a right-angled edge .25."""
_MIN_VOTE_RATIO = 0.5
"""Part of the most outlines that pass a point on a line of sight, from which on another point is touched as well. On a
bracket with a hole, 15 to 23 of 72 pass the points of the hole's edge and 3 to 9 the pyramid's around it."""
_COUNT_ROUNDS = 2
"""Times that the outlines which pass a point are counted, the second time only those that chose it. On that bracket the
mean distance is .43 % of the diagonal with one, .34 with two, .35 with four."""
_ANCHOR_WEIGHT = 1e-3
"""Weight of the hull's own position, relative to the membrane's: parts that no outline touches stay about there."""
_MAX_ITERATIONS = 300
"""Iterations of the conjugate gradient method at most."""


def fair_hull(
    hull: Float32[np.ndarray, "x y z"], outlines: Sequence[Outline], grid: Grid, diagonal: float
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return how far inside the smaller hull each cell lies, and how far from the nearest touched point, meters."""
    surface = enclose(hull, grid)
    points, faces = surface.vertices.double().numpy(), surface.faces.numpy()
    full = ndimage.gaussian_filter((hull > 0).astype(np.float32), _BLUR_RATIO * diagonal / grid.spacing)
    bent = ndimage.map_coordinates(full, ((points - grid.lowest) / grid.spacing).T, order=1, output=np.float64)
    touched = _touched(outlines, points, bent)
    if not touched.any():
        return hull, np.full(grid.shape, diagonal, dtype=np.float32)
    drawn = _membrane(points, faces, touched)
    across = trimesh.triangles.cross(points[faces])
    normals = trimesh.geometry.mean_vertex_normals(len(points), faces, across)  # type: ignore[no-untyped-call]
    inward = np.maximum(((points - drawn) * normals).sum(axis=1), 0.0)
    fall = np.zeros(grid.shape, dtype=np.float32)
    cells = tuple(np.rint((points - grid.lowest) / grid.spacing).astype(int).T)
    np.maximum.at(fall, cells, inward.astype(np.float32))
    far = np.ones(grid.shape, dtype=bool)
    far[cells] = False
    nearest = ndimage.distance_transform_edt(far, return_distances=False, return_indices=True)
    fall = fall[tuple(nearest)]
    # A low pyramid is lowered with what lies just below it; farther below nothing changes.
    taut = np.where((hull > 0) & (hull < 2.0 * (fall + grid.spacing)), hull - fall, hull)
    away = np.ones(grid.shape, dtype=bool)
    away[tuple(each[touched] for each in cells)] = False
    return taut, ndimage.distance_transform_edt(away).astype(np.float32) * np.float32(grid.spacing)


def _touched(
    outlines: Sequence[Outline], points: Float64[np.ndarray, "points 3"], bent: Float64[np.ndarray, " points"]
) -> Bool[np.ndarray, " points"]:
    """Return which points of a hull's surface the object is taken to touch."""
    passing = [_passing(each, points) for each in outlines]
    votes = np.bincount(np.concatenate([rows for rows, _ in passing]), minlength=len(points)).astype(np.float64)
    for _ in range(_COUNT_ROUNDS):
        chosen = np.zeros(len(points))
        for each, (rows, pixels) in zip(outlines, passing, strict=True):
            often = votes[rows] >= _MIN_VOTE_RATIO * _largest(votes[rows], pixels, each.inside.shape)
            few, where = rows[often], pixels[:, often]
            chosen[few[bent[few] <= _BEND_TOLERANCE - _largest(-bent[few], where, each.inside.shape)]] += 1
        votes = chosen
    return votes > 0


def _passing(
    outline: Outline, points: Float64[np.ndarray, "points 3"]
) -> tuple[Int[np.ndarray, " found"], Int[np.ndarray, "2 found"]]:
    """Return which points an outline passes, and the rows and columns of their pixels."""
    projection = outline.camera.projection.numpy()
    seen = points @ projection[:, :3].T + projection[:, 3]
    pixels = seen[:, :2] / np.maximum(seen[:, 2:], 1e-12)
    height, width = outline.inside.shape
    rows = np.flatnonzero((seen[:, 2] > 0) & (pixels > 0).all(axis=1) & (pixels < [width, height]).all(axis=1))
    apart = ndimage.map_coordinates(outline.inside, pixels[rows, ::-1].T - 0.5, order=1, mode="nearest")
    rows = rows[np.abs(apart) < _TOUCH_PIXELS]
    return rows, pixels[rows, ::-1].astype(int).T


def _largest(
    values: Float64[np.ndarray, " found"], pixels: Int[np.ndarray, "2 found"], shape: tuple[int, int]
) -> Float64[np.ndarray, " found"]:
    """Return the largest value in each one's pixel and those around: their lines of sight touch in the same point."""
    found = np.full(shape, -np.inf)
    np.maximum.at(found, tuple(pixels), values)
    largest: Float64[np.ndarray, " found"] = ndimage.maximum_filter(found, 3)[tuple(pixels)]
    return largest


def _membrane(
    points: Float64[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"], fixed: Bool[np.ndarray, " points"]
) -> Float64[np.ndarray, "points 3"]:
    """Return where the vertices of a stretched membrane lie that is `fixed` at some of them, meters."""
    ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = len(points)
    links = scipy.sparse.csr_array((np.ones(len(ends)), ends.T), shape=(count, count))
    links = links.maximum(links.T)
    pull = scipy.sparse.dia_array((np.asarray(links.sum(axis=0))[None], [0]), shape=(count, count)).tocsr() - links
    free = np.flatnonzero(~fixed)
    matrix = pull[free][:, free] + _ANCHOR_WEIGHT * scipy.sparse.eye_array(len(free), format="csr")
    right = _ANCHOR_WEIGHT * points[free] - pull[free][:, np.flatnonzero(fixed)] @ points[fixed]
    scale = scipy.sparse.dia_array((1.0 / matrix.diagonal()[None], [0]), shape=matrix.shape)
    drawn = points.copy()
    for axis in range(3):
        drawn[free, axis] = scipy.sparse.linalg.cg(
            matrix, right[:, axis], x0=points[free, axis], rtol=1e-5, maxiter=_MAX_ITERATIONS, M=scale
        )[0]
    return drawn
