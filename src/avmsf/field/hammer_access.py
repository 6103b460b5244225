"""Which places of an object a hammer can strike from outside.

The hammer is a straight rod with a rounded tip, without end, which moves along its axis: a modal hammer's head, or a
pencil. It strikes a place if it touches the surface there, leans at most `MAX_TILT_DEGREES` from the outward normal,
and lies clear of the object. So places inside walls, in closed cavities, in narrow gaps and deep in narrow vessels
cannot be struck.
"""

import math

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial import cKDTree

from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.rays import RayCaster

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
_MAX_POINTS = 12_000
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
    points = points[:: -(-len(points) // _MAX_POINTS)]
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
