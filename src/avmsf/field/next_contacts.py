"""Where to strike next: of the places that a hammer can reach, those whose recordings would tell most of the field.

The hammer is a straight rod with a rounded tip, without end, which moves along its axis: a modal hammer's head, or a
pencil. It strikes a place if it touches the surface there, leans at most `MAX_TILT_DEGREES` from the outward normal,
and lies clear of the object. So places inside walls, in closed cavities, in narrow gaps and deep in narrow vessels
cannot be struck. Of the others those are suggested that reduce the expected error of the whole field most.
"""

import math
from dataclasses import dataclass
from typing import SupportsIndex

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_count, as_directions, as_vectors, short_repr
from avmsf._utils.progress import ProgressDisplay
from avmsf.errors import FitError
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import off_surface
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.mesh.points import farthest_points
from avmsf.mesh.queries import ClosestPoints, RayCaster

HAMMER_DIAMETER = 0.01
"""Meters. A pencil has 7 mm, the head of the usual modal hammer (PCB 086C03) 16 mm and its tip 6 mm."""
_RADIUS = 0.5 * HAMMER_DIAMETER
MAX_TILT_DEGREES = 45.0
"""Angle between the hammer and the normal beyond which more of the force goes along the surface than into it."""
MAX_DISTANCE_RATIO = 0.02
"""Distance of a place from the surface over the object's size up to which the impact meant is that on the surface."""
_TILTS, _TURNS, _SIDES = 4, 12, 8
"""Tilts and turns of the axes that are tried, and lines along the rod that are checked beside its axis."""
_GAP_RATIO = 1e-4
"""Gap between tip and surface, over the object's size, so that rounding lets no rod touch the triangle it strikes."""
_MAX_BLOCKING_POINTS = 12_000
"""Points that can block a rod, of an object without triangles."""
_NEIGHBORS = 12
"""Points around a place that a normal is fitted to, and that the rod is thick enough to meet: where points are
scattered at random, one disc in e^12 = 160,000 of that size has none."""


def reached_on_mesh(
    vertices: Float64[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    places: Float64[np.ndarray, "places 3"],
) -> tuple[Bool[np.ndarray, " places"], Float64[np.ndarray, "places 3"], Float64[np.ndarray, "places 3"]]:
    """Return which places, meters, can be struck, the surface's nearest points, and the hammer's axis there.

    The surface is closed, or an open one that is seen from outside. The axis is a unit vector away from it: of those
    that lie clear the one nearest to the normal.
    """
    size, triangles = float(np.linalg.norm(np.ptp(vertices, axis=0))), vertices[faces]
    crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = np.linalg.norm(crosses, axis=1)
    triangles, all_normals = triangles[areas > 0], crosses[areas > 0] / areas[areas > 0, None]
    found, gap, rays = ClosestPoints(triangles)(places), _GAP_RATIO * size, RayCaster(triangles)
    feet, normals = (triangles[found.rows] * found.weights[:, :, None]).sum(axis=1), all_normals[found.rows]
    tips, near = feet + (_RADIUS + gap) * normals, found.distances <= MAX_DISTANCE_RATIO * size
    open_to = near & (rays(feet + gap * normals, normals, lead=0.0)[1] > _RADIUS)
    reached, used = np.zeros(len(places), dtype=bool), normals.copy()
    for axes in _axes(normals):
        left = np.flatnonzero(open_to & ~reached)
        reached[left] = _lies_clear(rays, tips[left], axes[left])
        used[left] = axes[left]
    return reached, feet, used


def _lies_clear(
    rays: RayCaster, tips: Float64[np.ndarray, "rods 3"], axes: Float64[np.ndarray, "rods 3"]
) -> Bool[np.ndarray, " rods"]:
    """Return whether rods with these middles of their round tips meet no triangle."""
    clear = np.isinf(rays(tips, axes, lead=0.0)[1])
    one, other = _across(axes)
    for turn in range(_SIDES):
        angle = 2 * math.pi * turn / _SIDES
        outward = math.cos(angle) * one + math.sin(angle) * other
        clear &= rays(tips, outward, lead=0.0)[1] > _RADIUS
        clear &= np.isinf(rays(tips + _RADIUS * outward, axes, lead=0.0)[1])
    return clear


def reached_on_points(
    points: Float64[np.ndarray, "points 3"], places: Float64[np.ndarray, "places 3"]
) -> Bool[np.ndarray, " places"]:
    """Return which places, meters, can be struck on a surface of which points are known all over.

    Between points the surface is unknown, so the rod is thick enough to slip through none of it. A place on one side of
    a thinner wall can be struck if the other side can: the two are one.
    """
    points = points[:: -(-len(points) // _MAX_BLOCKING_POINTS)]
    tree, count = cKDTree(points), min(_NEIGHBORS + 1, len(points))
    radius = max(_RADIUS, float(np.median(tree.query(points, k=count)[0].reshape(len(points), -1)[:, -1])))
    near = points[tree.query(places, k=count)[1].reshape(len(places), -1)]
    # The direction in which the points around each place spread least.
    normals = np.linalg.svd(near - near.mean(axis=1, keepdims=True), full_matrices=True)[2][:, -1]

    def clear(tip: Float64[np.ndarray, "3"], axes: Float64[np.ndarray, "axes 3"]) -> Bool[np.ndarray, " axes"]:
        offsets = points - tip
        along = offsets @ axes.T
        across = (offsets**2).sum(axis=1)[:, None] - along**2
        return ~((along > 0) & (across < radius**2)).any(axis=0)

    reached = np.zeros(len(places), dtype=bool)
    for side in (normals, -normals):
        tips, axes = places + radius * side, np.stack(_axes(side), axis=1)
        # A tip that overlaps the surface by more than a third of its radius strikes what is behind it.
        for row in np.flatnonzero((tree.query(tips)[0] > radius * 2 / 3) & ~reached):
            reached[row] = clear(tips[row], axes[row]).any()
    return reached


def _axes(normals: Float64[np.ndarray, "places 3"]) -> list[Float64[np.ndarray, "places 3"]]:
    """Return the directions from the tip along the rod that are tried at each place, the normals first."""
    one, other = _across(normals)
    axes = [normals]
    for tilt in np.radians(np.linspace(0.0, MAX_TILT_DEGREES, _TILTS)[1:]):
        for turn in 2 * math.pi * np.arange(_TURNS) / _TURNS:
            axes.append(math.cos(tilt) * normals + math.sin(tilt) * (math.cos(turn) * one + math.sin(turn) * other))
    return axes


def _across(axes: Float64[np.ndarray, "axes 3"]) -> tuple[Float64[np.ndarray, "axes 3"], Float64[np.ndarray, "axes 3"]]:
    """Return two unit vectors perpendicular to each axis and to each other."""
    least = np.eye(3)[np.abs(axes).argmin(axis=1)]
    one = np.cross(axes, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(axes, one)


MAX_POINTS = 400
"""Points of the surface that the expected error is summed over, and that are candidates unless others are given."""
MAX_CANDIDATES = 500
"""Candidates that are weighed; of more, as many that lie far apart. The memory grows with their square."""
_SAME_POSITION_RATIO = 1e-6
"""Distance between two places over the object's size, below which they are one."""


@dataclass(frozen=True, eq=False)
class Suggestions:
    """Suggested contacts of the next impacts, in this order, with the expected error after each.

    Errors are relative: the square root of the expected squared error of the gains, as energy, over the energy that is
    expected on the mean over the surface. 0 is certainty, 1 as wrong as silence. `before` is that of the present
    recordings, `after` those after each contact and the ones before it; `rows` tells which candidates the contacts are.
    """

    __repr__ = short_repr

    contacts: Float64[Tensor, "contacts 3"]
    """Object frame, meters."""
    directions: Float64[Tensor, "contacts 3"] | None
    """Unit vectors of the impacts' directions: as given, or the nearest to straight into the field's body that a hammer
    can take; without a body that of the nearest recording; None if the field does not depend on directions."""
    rows: Int[Tensor, " contacts"]
    """Which of the candidates they are."""
    before: float
    """Expected error of the whole field with the present recordings."""
    after: tuple[float, ...]
    """Expected error of the whole field after each of the contacts and those before it."""
    points: Float64[Tensor, "points 3"]
    """Points spread evenly over the surface, meters."""
    unreachable: int = 0
    """How many of `points` were no candidates because a hammer cannot reach them from outside."""


def suggest(
    field: SoundField,
    count: SupportsIndex = 5,
    *,
    candidates: ArrayLike | None = None,
    directions: ArrayLike | None = None,
    unseen: bool = False,
    progress: bool = True,
) -> Suggestions:
    """Return the contacts that lower the expected error of the whole field most, each given those before it.

    Args:
        field: A field whose gains have a posterior.
        count: Number of contacts; fewer come where fewer candidates have no recording.
        candidates: Places on the surface [candidates, 3], meters; contacts of the fit are passed over. By default
            points that a hammer can strike from outside.
        directions: Unit vectors [candidates, 3] of their impacts; zeros, as the default, are straight into the surface.
        unseen: Use all of the surface of the field's body, also where no photograph shows the object.
        progress: Whether a terminal shows that it works.

    Returns:
        The contacts [count, 3], meters, and the expected error after each.

    Raises:
        ArrayError: For candidates and directions of other shapes, or with values that are not finite.
        FitError: For gains without a posterior, no candidate that has no recording and can be struck, other unfit
            arguments, and `unseen` without a body.
    """
    count = as_count(count, "count", raising=FitError)
    given = None if candidates is None else as_vectors(candidates, "candidates").double()
    gains = _mixture_of(field, unseen)
    known = 0 if given is None else len(given)
    vectors = None if directions is None else as_directions(directions, "directions", count=known)
    with ProgressDisplay(shown=progress) as display:
        display.doing("computing the expected error over the surface")
        surface = gains.body.nodes if unseen and gains.body is not None else gains.points
        points = surface[farthest_points(surface, min(MAX_POINTS, len(surface)))].double()
        if given is not None:
            _expect_on_surface(given, gains)
        pool, vectors = _reachable(gains, points) if given is None else (given, vectors)
        same = _SAME_POSITION_RATIO * float((points.amax(0) - points.amin(0)).norm())
        allowed = (pool[:, None] - gains.contacts).norm(dim=2).amin(1) > same
        if not bool(allowed.any()):
            wanted, got = "a place without a recording", f"none of {len(pool)}"
            raise FitError.expected(wanted, 0, got=got, name="candidates", advice="give other candidates")
        kept, most = torch.arange(len(pool)), max(MAX_CANDIDATES, count)
        if len(pool) > most:
            kept = torch.nonzero(allowed).flatten()
            kept = kept[farthest_points(pool[kept], min(most, len(kept)))].sort().values
        sites = gains.sites(pool[kept], None if vectors is None else vectors[kept])
        rows, (before, *after) = _choose(field, gains, points, sites, allowed[kept], count, same=same)
    return Suggestions(
        sites.points[rows],
        sites.directions[rows] if gains.directional else None,
        kept[rows],
        before,
        tuple(after),
        points,
        len(points) - len(pool) if given is None else 0,
    )


def _mixture_of(field: SoundField, unseen: bool) -> MixtureGains:
    """Return the gains of a field. Raises FitError for an edited field, and with `unseen` for one without a body."""
    if isinstance(field.gain_field, ScaledGains):
        wanted, advice = "a field as fitted", "give the unedited field"
        raise FitError.expected(wanted, "edited", got="an edited one", name="field", advice=advice)
    gains = field.fitted_mixture
    if unseen and gains.body is None:
        wanted, advice = "a field with the object's surface", "leave unseen out, or give candidates"
        raise FitError.expected(wanted, True, got="one without", name="unseen", advice=advice)
    return gains


def _choose(
    field: SoundField,
    gains: MixtureGains,
    points: Float64[Tensor, "points 3"],
    candidates: Sites,
    allowed: Bool[Tensor, " candidates"],
    count: int,
    *,
    same: float,
) -> tuple[list[int], list[float]]:
    """Return the rows of `count` allowed candidates that lower the expected error at points most in turn, taken as
    measured, and the error before and after each; fewer where fewer lie farther apart than `same`.
    """
    places = torch.cat([points, candidates.points])
    directions = torch.cat([gains.sites(points).directions, candidates.directions])
    weights, size = (1.0 / (4.0 * field.bank.damping)).tolist(), len(points)
    # At the points, all modes together; and each mode's covariances between all places and candidates, and its noise.
    variance, modes = torch.zeros(size, dtype=torch.float64), []
    for mode, covariance, noise in gains.covariances(places, directions):
        variance += weights[mode] * torch.diagonal(covariance)[:size].clamp_min(0.0)
        modes.append((weights[mode] * covariance[:, size:], weights[mode] * noise))
    energy = float(field.energy(gains.predict(points.float()).parts).mean() + variance.mean())

    def measured(shared: Float64[Tensor, "places candidates"], noise: float) -> Float64[Tensor, " candidates"]:
        """Return the variance of a measured gain at each candidate."""
        own = torch.diagonal(shared[size:]).clamp_min(0.0)
        return (own + noise).clamp_min(torch.finfo(torch.float64).tiny)

    rows, errors = list[int](), [math.sqrt(float(variance.mean()) / energy)]
    while len(rows) < count and bool(allowed.any()):
        reduced = [shared[:size].square().sum(0) / measured(shared, noise) for shared, noise in modes]
        rows.append(row := int(torch.where(allowed, torch.stack(reduced).sum(0), -math.inf).argmax()))
        for shared, noise in modes:
            column, scale = shared[:, row].clone(), measured(shared, noise)[row]
            variance = (variance - column[:size].square() / scale).clamp_min(0.0)
            shared -= torch.outer(column, column[size:]) / scale
        allowed = allowed & ((candidates.points - candidates.points[row]).norm(dim=1) > same)
        errors.append(math.sqrt(float(variance.mean()) / energy))
    return rows, errors


def _reachable(
    gains: MixtureGains, points: Float64[Tensor, "points 3"]
) -> tuple[Float64[Tensor, "places 3"], Float64[Tensor, "places 3"] | None]:
    """Return the points that a hammer can strike, with a body moved onto its surface, and along which direction."""
    body, places, axes = gains.body, points.numpy(), None
    if body is None:
        reached = reached_on_points(gains.points.double().numpy(), places)
    else:
        reached, places, axes = reached_on_mesh(body.nodes.double().numpy(), body.triangles[:, :3].numpy(), places)
    if not reached.any():
        wanted = f"positions that a hammer of {1000 * HAMMER_DIAMETER:g} mm reaches from outside"
        advice = "check the object's shape, or give candidates"
        raise FitError.expected(wanted, 0, got=f"none of {len(points)}", name="candidates", advice=advice)
    return torch.from_numpy(places[reached]), None if axes is None else -torch.from_numpy(axes[reached])


def _expect_on_surface(candidates: Float64[Tensor, "candidates 3"], gains: MixtureGains) -> None:
    row, distance = max(off_surface(candidates, gains), key=lambda each: each[1], default=(0, 0.0))
    if distance:
        found = [round(each, 4) for each in candidates[row].tolist()]
        raise FitError.expected(
            "a position on the object's surface", found, got=f"{found} m, {distance:.2g} m from it",
            row=row, name="candidates", advice="check the unit and the frame",
        )  # fmt: skip
