"""Noise taken out of a mesh, as much of it as the mesh itself shows.

A scan's noise is drawn afresh at each vertex, while a surface runs on from one vertex to the next. Of the surfaces
that balance closeness to the vertices against bending, (1 + strength L L) places = vertices with L the mean difference
from the neighbors, generalized cross-validation takes the one that would predict left-out vertices best.
"""

import math

import numpy as np
import scipy.optimize
import scipy.sparse
from jaxtyping import Float64
from scipy.sparse.linalg import splu

from avmsf.fem.skin import Skin, unit

ROUGH = 20.0
"""Degrees that neighboring triangles differ by on the mean, in a mesh that is likelier noisy than finely shaped."""
_FINE = 0.06
"""Mean edge over the body's size from which on a mesh is too coarse to tell noise from form: a box turns by 60."""
_PROBES = 8
"""Random vectors that estimate the number of degrees of freedom left, within a per cent for thousands of vertices."""
_WEAKEST, _STRONGEST = -3.0, 5.0
"""Decimal logarithms of the strengths to choose from."""
_KEPT = 0.8
"""Part of the vertices' degrees of freedom that a mesh without noise would keep."""


def roughness(skin: Skin) -> float:
    """Return the mean angle between the normals of neighboring triangles, degrees; 0 for a mesh of few long edges."""
    corners = skin.points[skin.faces]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    ends = np.sort(skin.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    names = ends[:, 0] * len(skin.points) + ends[:, 1]
    _, which, count = np.unique(names, return_inverse=True, return_counts=True)
    order = np.argsort(which, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)])[:-1][count == 2]
    if not len(starts):
        return 0.0
    one, other = order[starts], order[starts + 1]
    lengths = np.linalg.norm(skin.points[ends[one, 0]] - skin.points[ends[one, 1]], axis=1)
    if lengths.mean() > _FINE * skin.size:
        return 0.0
    angles = np.arccos(np.clip((normals[one // 3] * normals[other // 3]).sum(axis=1), -1.0, 1.0))
    return math.degrees(float(angles.mean()))


def denoised(skin: Skin) -> tuple[Skin, float]:
    """Return a noisy mesh without its noise, and how far that moved the vertices, meters, root mean square.

    A mesh that is not rough, or whose vertices predict each other no better when smoothed, comes back as it is, with
    0. The volume of a closed one stays.
    """
    if roughness(skin) < ROUGH:
        return skin, 0.0
    bending = _bending(skin)
    probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(skin.points), _PROBES))
    identity = scipy.sparse.eye_array(len(skin.points), format="csc")

    def smooth(exponent: float) -> tuple[Float64[np.ndarray, "points 3"], float]:
        solve = splu(
            identity + 10.0**exponent * bending, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        ).solve
        return solve(skin.points), float((probes * solve(probes)).sum(axis=0).mean() / len(probes))

    def error(exponent: float) -> float:
        points, kept = smooth(exponent)
        return math.log(float(((points - skin.points) ** 2).mean()) / (1.0 - kept) ** 2)

    found = scipy.optimize.minimize_scalar(error, bounds=(_WEAKEST, _STRONGEST), options={"xatol": 0.05})
    points, kept = smooth(float(found.x))
    if kept > _KEPT:
        return skin, 0.0
    smoothed = _as_large(Skin(points, skin.faces), skin)
    return smoothed, float(np.sqrt(((smoothed.points - skin.points) ** 2).sum(axis=1).mean()))


def averaged(skin: Skin, rounds: int) -> Skin:
    """Return a skin whose points were moved, so many times, to the mean of themselves and their neighbors.

    The volume of a closed one stays.
    """
    step = _averaging(_joined(skin) + scipy.sparse.eye_array(len(skin.points)))
    points = skin.points
    for _ in range(rounds):
        points = step @ points
    return _as_large(Skin(points, skin.faces), skin)


def _bending(skin: Skin) -> scipy.sparse.csc_array:
    """Return the squared difference of each point from the mean of its neighbors, as a matrix."""
    difference = scipy.sparse.eye_array(len(skin.points)) - _averaging(_joined(skin))
    return (difference.T @ difference).tocsc()


def _averaging(joined: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Return what takes the mean over the points that each is joined to."""
    return scipy.sparse.diags_array(1.0 / joined.sum(axis=1)) @ joined


def _joined(skin: Skin) -> scipy.sparse.csr_array:
    """Return 1 for points that share an edge."""
    count = len(skin.points)
    ends = skin.faces[:, [[0, 1], [1, 2], [2, 0], [1, 0], [2, 1], [0, 2]]].reshape(-1, 2)
    joined = scipy.sparse.csr_array((np.ones(len(ends)), ends.T), shape=(count, count))
    joined.data[:] = 1.0
    return joined


def _as_large(smoothed: Skin, skin: Skin) -> Skin:
    """Return a closed skin grown evenly from its middle to the volume it had, for smoothing shrinks what is round."""
    if skin.open_edges or smoothed.volume == 0.0 or skin.volume / smoothed.volume <= 0.0:
        return smoothed
    middle = smoothed.points.mean(axis=0)
    factor = float(np.cbrt(skin.volume / smoothed.volume))
    return Skin(middle + factor * (smoothed.points - middle), skin.faces)
