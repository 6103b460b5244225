"""Walls that are not equally thick everywhere, as no real ones are."""

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float64, Int
from scipy.sparse.linalg import splu

from avmsf.errors import SimulationError
from avmsf.fem.solid import Solid
from avmsf.mesh.rays import RayCaster
from avmsf.simulate.imperfections import smooth_field
from avmsf.simulate.shapes.body import mitred_normals

_MIN_VOLUME_RATIO = 0.02
"""Part of its volume below which a tetrahedron is moved as a whole instead."""
_MAX_REPAIRS = 30
_RAY_LEAD = 1e-4
"""How far inside of the surface rays start, in object diagonals."""


def vary_thickness(solid: Solid, part: float, *, generator: np.random.Generator) -> Solid:
    """Return a solid whose walls are thicker here and thinner there, smoothly, by chance.

    `part` is the root mean square of the thickness over the surface relative to its mean, which stays as it is; 0
    returns the solid itself. Thickness varies over lengths from .4 diagonals on. Both sides of a wall move along their
    normals by half of what it grows, and points inside go along with those around them. No tetrahedron is turned inside
    out. Raises SimulationError for tetrahedra so flat that they cannot move.
    """
    if part == 0.0:
        return solid
    rows, inverse = np.unique(solid.boundary.numpy(), return_inverse=True)
    triangles, places = inverse.reshape(-1, 3), solid.points.numpy()[rows]
    corners = places[triangles]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(doubled, axis=1)
    share = np.bincount(triangles.ravel(), weights=np.repeat(areas, 3))
    field = torch.log(smooth_field(torch.from_numpy(places), 1.0, diagonal=solid.size, generator=generator)).numpy()
    factor = _factors(field, share, part)
    _, reach = RayCaster(corners)(corners.mean(axis=1), -doubled / areas[:, None], lead=_RAY_LEAD)
    hit = np.isfinite(reach)
    # At a rim the walls' thickness, not the rim's distance from what lies below it.
    walls = np.full(len(places), np.inf)
    np.minimum.at(walls, triangles, np.where(hit, reach, np.median(reach[hit]))[:, None])
    moved = 0.5 * ((factor - 1.0) * walls)[:, None] * mitred_normals(places, triangles)
    motion = _carried(solid, rows, moved)
    return Solid.build(solid.points + torch.from_numpy(_repaired(solid, motion)), solid.cells)


def _factors(
    field: Float64[np.ndarray, " points"], share: Float64[np.ndarray, " points"], part: float
) -> Float64[np.ndarray, " points"]:
    """Return positive factors of mean 1 and this root mean square deviation that rise with a field."""
    strength = part
    for _ in range(50):
        factor = np.exp(strength * (field - field.mean()))
        factor /= np.average(factor, weights=share)
        found = float(np.sqrt(np.average((factor - 1.0) ** 2, weights=share)))
        strength = strength * part / found
    return factor


def _carried(
    solid: Solid, rows: Int[np.ndarray, " outer"], moved: Float64[np.ndarray, "outer 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Return the motion of all points: inner ones move as the mean of those that share an edge with them."""
    count = len(solid.points)
    motion = np.zeros((count, 3))
    motion[rows] = moved
    inner = np.setdiff1d(np.arange(count), rows)
    if len(inner):
        cells = solid.cells.numpy()
        pairs = np.concatenate([cells[:, [one, other]] for one in range(4) for other in range(4) if one != other])
        joined = scipy.sparse.csr_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
        balance = scipy.sparse.diags_array(joined.sum(axis=1)) - joined
        own, others = balance[inner][:, inner].tocsc(), balance[inner][:, rows]
        motion[inner] = splu(own).solve(-(others @ moved))
    return motion


def _repaired(solid: Solid, motion: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
    """Return the motion with the corners of tetrahedra that it would crush moved alike instead."""
    before, cells = solid.volumes.numpy(), solid.cells.numpy()
    for _ in range(_MAX_REPAIRS):
        corners = (solid.points.numpy() + motion)[cells]
        crushed = cells[np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0 < _MIN_VOLUME_RATIO * before]
        if not len(crushed):
            return motion
        means = np.repeat(motion[crushed].mean(axis=1), 4, axis=0)
        touched, which = np.unique(crushed, return_inverse=True)
        motion = motion.copy()
        for axis in range(3):
            motion[touched, axis] = np.bincount(which.ravel(), weights=means[:, axis]) / np.bincount(which.ravel())
    got = f"{len(crushed)} of {len(cells)} inverted"
    advice = "vary the thickness less, or make the tetrahedra with another detail"
    wanted = "a variation that keeps all tetrahedra"
    raise SimulationError.expected(wanted, len(crushed), got=got, name="part", advice=advice)
