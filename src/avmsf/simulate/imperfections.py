"""What makes a simulated object as untidy as a real one, each thing by itself and by seed.

All random numbers of one thing come from a stream of its own, so that switching one off changes none of the others.
"""

import math

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float64, Int
from scipy.sparse.linalg import splu
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.solid import Solid
from avmsf.fem.vibration import Vibration, rayleigh
from avmsf.mesh.queries import RayCaster
from avmsf.simulate.recipe import Imperfections
from avmsf.simulate.shapes.body import mitred_normals, stream

_LEGS = 3
_PATCHES = 16
"""Places where damping sits that couples modes."""
_WAVES = 24
"""Plane waves of which a smooth random field is made."""
_MIN_WAVELENGTH = 0.4
"""Shortest wavelength of such a field, in object diagonals; the longest is five times that."""
_MIN_VOLUME_RATIO = 0.02
"""Part of its volume below which a tetrahedron is moved as a whole instead."""
_MAX_REPAIRS = 30
_RAY_LEAD = 1e-4
"""How far inside of the surface rays start, in object diagonals."""


def recording_starts(
    count: int, imperfections: Imperfections, *, delay: float, sample_rate: float, seed: int
) -> Float64[Tensor, " contacts"]:
    """Return the sample of each recording, counted from 0 and between samples too, at which the impact's sound starts.

    `delay` is the time that sound takes to the microphone, seconds. Negative where the recording starts too late.
    """
    drawn = torch.from_numpy(stream(seed, "recording starts").standard_normal(count))
    before = imperfections.pretrigger + imperfections.propagation * delay
    return sample_rate * (before + imperfections.jitter * drawn)


def frequency_factors(
    modes: ElasticModes, vibration: Vibration, places: Float64[Tensor, "contacts 3"], imperfections: Imperfections
) -> Float64[Tensor, "contacts modes"]:
    """Return what multiplies the frequency of each damped mode in the recording of each contact.

    A point mass m lowers the frequency of a mode of mass-normalized shape phi to 1 / sqrt(1 + m |phi|^2) (Rayleigh).
    """
    shapes = torch.stack([modes.gains(places, axis.expand_as(places)) for axis in torch.eye(3, dtype=torch.float64)])
    parts = vibration.pushes.abs().square()
    loads = shapes.square().sum(0) @ (parts / parts.sum(1, keepdim=True)).T
    times = torch.linspace(0.0, 1.0, len(places), dtype=torch.float64)[:, None]
    return (1.0 + imperfections.sensor * modes.mass * loads).rsqrt() * (1.0 - imperfections.warming * times)


def smooth_field(
    places: Float64[Tensor, "points 3"], spread: float, *, diagonal: float, generator: np.random.Generator
) -> Float64[Tensor, " points"]:
    """Return factors that vary smoothly over a body of this diagonal, meters, with a mean near 1.

    Their logarithm is a sum of plane waves with random directions, phases and wavelengths, of this root mean square.
    """
    if spread == 0.0:
        return torch.ones(len(places), dtype=torch.float64)
    directions = generator.standard_normal((_WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = _MIN_WAVELENGTH * diagonal * np.exp(generator.uniform(0.0, math.log(5.0), _WAVES))
    phases = generator.uniform(0.0, 2.0 * math.pi, _WAVES)
    heights = np.cos(2.0 * math.pi * places.numpy() @ (directions / lengths[:, None]).T + phases).sum(axis=1)
    return torch.from_numpy(np.exp(spread * math.sqrt(2.0 / _WAVES) * heights))


def support_places(
    surface: Float64[Tensor, "points 3"], up: Float64[Tensor, " 3"], *, generator: np.random.Generator
) -> Float64[Tensor, "legs 3"]:
    """Return three of the surface's points that it could stand on, as far apart as the low ones allow."""
    height = surface @ up
    low = surface[height <= height.min() + 0.05 * (height.max() - height.min()).clamp(min=1e-9)]
    middle = low.mean(dim=0)
    start = generator.uniform(0.0, 2.0 * math.pi)
    across = torch.linalg.svd(up[None])[2][1:]
    turns = start + 2.0 * math.pi / _LEGS * torch.arange(_LEGS, dtype=torch.float64)
    ways = torch.cos(turns)[:, None] * across[0] + torch.sin(turns)[:, None] * across[1]
    return low[((low - middle) @ ways.T).argmax(dim=0)]


def damping_matrix(
    modes: ElasticModes,
    imperfections: Imperfections,
    *,
    supports: Float64[Tensor, "legs 3"],
    generator: np.random.Generator,
) -> Float64[Tensor, "modes modes"]:
    """Return how velocities of undamped modes brake each other, 1/s: symmetric and positive definite.

    With D the dampings of Rayleigh's law on a diagonal, S the shapes at the supports and W the products of the shapes
    at random patches, rows scaled to length 1,

        C = D^(1/2) ((1 - coupling) + coupling W W^T) D^(1/2) + c S S^T.

    The first part keeps each mode's own damping and makes it uneven over the body.
    """
    own = rayleigh(modes.frequency, modes.material)
    matrix = torch.diag(own)
    if imperfections.coupling > 0.0:
        rows = generator.integers(len(modes.nodes), size=_PATCHES)
        shapes = modes.shapes[torch.from_numpy(rows)].transpose(0, 1).reshape(len(modes), -1)
        shapes = shapes / shapes.norm(dim=1, keepdim=True).clamp(min=1e-300)
        root = torch.sqrt(own)
        mixed = root[:, None] * (shapes @ shapes.T) * root
        matrix = matrix + imperfections.coupling * (mixed - matrix)
    if imperfections.support > 0.0 and imperfections.support_damping > 0.0:
        rate = 2.0 * math.pi * imperfections.support
        damper = 2.0 * imperfections.support_damping * modes.mass * rate / _LEGS
        held = modes.at(supports).transpose(0, 1).reshape(len(modes), -1)
        matrix = matrix + damper * held @ held.T
    return matrix


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
    _, reach, _ = RayCaster(corners)(corners.mean(axis=1), -doubled / areas[:, None], lead=_RAY_LEAD)
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
