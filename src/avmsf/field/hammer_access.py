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


class MeshAccess:
    """Tests places by the triangles of a closed surface, or of an open one that is seen from outside."""

    def __init__(self, vertices: Float64[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]) -> None:
        self._size, triangles = float(np.linalg.norm(np.ptp(vertices, axis=0))), vertices[faces]
        crosses = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        areas = np.linalg.norm(crosses, axis=1)
        solid = areas > 0
        self._triangles, self._normals = triangles[solid], crosses[solid] / areas[solid, None]
        self._closest, self._rays = ClosestPoints(self._triangles), RayCaster(self._triangles)

    def __call__(
        self, places: Float64[np.ndarray, "places 3"]
    ) -> tuple[Bool[np.ndarray, " places"], Float64[np.ndarray, "places 3"], Float64[np.ndarray, "places 3"]]:
        """Return which places, meters, can be struck, the surface's nearest points, and the hammer's axis there.

        The axis is a unit vector away from the surface: of those that lie clear the one nearest to the normal.
        """
        found, gap = self._closest(places), _GAP_RATIO * self._size
        feet = (self._triangles[found.rows] * found.weights[:, :, None]).sum(axis=1)
        normals = self._normals[found.rows]
        tips, near = feet + (_RADIUS + gap) * normals, found.distances <= MAX_DISTANCE_RATIO * self._size
        open_to = near & (self._free(feet + gap * normals, normals) > _RADIUS)
        reached, used = np.zeros(len(places), dtype=bool), normals.copy()
        for axes in _axes(normals):
            left = np.flatnonzero(open_to & ~reached)
            reached[left] = self._clear(tips[left], axes[left])
            used[left] = axes[left]
        return reached, feet, used

    def _clear(
        self, tips: Float64[np.ndarray, "rods 3"], axes: Float64[np.ndarray, "rods 3"]
    ) -> Bool[np.ndarray, " rods"]:
        """Return whether rods with these middles of their round tips lie clear."""
        clear = np.isinf(self._free(tips, axes))
        one, other = _across(axes)
        for turn in range(_SIDES):
            angle = 2 * math.pi * turn / _SIDES
            outward = math.cos(angle) * one + math.sin(angle) * other
            clear &= self._free(tips, outward) > _RADIUS
            clear &= np.isinf(self._free(tips + _RADIUS * outward, axes))
        return clear

    def _free(
        self, origins: Float64[np.ndarray, "rays 3"], directions: Float64[np.ndarray, "rays 3"]
    ) -> Float64[np.ndarray, " rays"]:
        """Return the distance to the first triangle along each ray."""
        return self._rays(origins, directions, lead=0.0)[1]


class PointAccess:
    """Tests places by points all over a surface, where there are no triangles.

    Between points the surface is unknown, so the rod is thick enough to slip through none of it. A place on one side of
    a thinner wall can be struck if the other side can: the two are one.
    """

    def __init__(self, points: Float64[np.ndarray, "points 3"]) -> None:
        self._points = points[:: -(-len(points) // _MAX_POINTS)]
        self._tree = cKDTree(self._points)
        self._count = min(_NEIGHBORS + 1, len(self._points))
        apart = self._tree.query(self._points, k=self._count)[0].reshape(len(self._points), -1)[:, -1]
        self._radius = max(_RADIUS, float(np.median(apart)))

    def __call__(
        self, places: Float64[np.ndarray, "places 3"]
    ) -> tuple[Bool[np.ndarray, " places"], Float64[np.ndarray, "places 3"], None]:
        """Return which places, meters, can be struck, the places, and no axes: a normal of a few points is rough."""
        normals = self._normals(places)
        reached = np.zeros(len(places), dtype=bool)
        for side in (normals, -normals):
            tips = places + self._radius * side
            # A tip that overlaps the surface by more than a third of its radius strikes what is behind it.
            above = self._tree.query(tips)[0] > self._radius * 2 / 3
            axes = np.stack(_axes(side), axis=1)
            for row in np.flatnonzero(above & ~reached):
                reached[row] = self._clear(tips[row], axes[row]).any()
        return reached, places, None

    def _clear(self, tip: Float64[np.ndarray, "3"], axes: Float64[np.ndarray, "axes 3"]) -> Bool[np.ndarray, " axes"]:
        offsets = self._points - tip
        along = offsets @ axes.T
        across = (offsets**2).sum(axis=1)[:, None] - along**2
        return ~((along > 0) & (across < self._radius**2)).any(axis=0)

    def _normals(self, places: Float64[np.ndarray, "places 3"]) -> Float64[np.ndarray, "places 3"]:
        """Return the direction in which the points around each place spread least."""
        near = self._points[self._tree.query(places, k=self._count)[1].reshape(len(places), -1)]
        return np.linalg.svd(near - near.mean(axis=1, keepdims=True), full_matrices=True)[2][:, -1]


def _axes(normals: Float64[np.ndarray, "places 3"]) -> list[Float64[np.ndarray, "places 3"]]:
    """Return the directions from the tip along the rod that are tried at each place, the normals first."""
    one, other = _across(normals)
    axes = [normals]
    for tilt in np.radians(np.linspace(0.0, MAX_TILT_DEGREES, _TILTS)[1:]):
        for turn in 2 * math.pi * np.arange(_TURNS) / _TURNS:
            axes.append(math.cos(tilt) * normals + math.sin(tilt) * (math.cos(turn) * one + math.sin(turn) * other))
    return axes


def _across(
    axes: Float64[np.ndarray, "axes 3"],
) -> tuple[Float64[np.ndarray, "axes 3"], Float64[np.ndarray, "axes 3"]]:
    """Return two unit vectors perpendicular to each axis and to each other."""
    least = np.eye(3)[np.abs(axes).argmin(axis=1)]
    one = np.cross(axes, least)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(axes, one)
