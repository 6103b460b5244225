"""A mesh that shows both sides of a thin wall, filled by layers of prisms.

Tetrahedra that fill such a mesh without regard to its sides lock. Their outer and inner facets do not lie opposite to
each other, so the wall's thickness varies by the distance of the facets from the curved surface, and it cannot bend
without stretching. A free steel tube of 50 mm radius and 1.5 mm wall has its lowest mode 26 % too high with 34,000
degrees of freedom and 2 % with 85,000, but 2 % with 31,000 in prisms. Elements with curved sides lock more: 9 % there.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int
from trimesh import Trimesh

from avmsf.errors import SimulationError
from avmsf.fem.remeshing import adjacency, components, even_points, mesh_of, remeshed
from avmsf.fem.shell import prisms
from avmsf.fem.solid import Solid
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.rays import RayCaster

_OPPOSITE = -0.8
"""Largest cosine between the normals of the two sides."""
_CREASE = 0.7
"""Cosine of the angle between neighboring triangles that ends a side."""
_THICKER = 2.5
"""Distance to the other side over twice the volume by area, from which on a triangle is on a rim or a lump."""
_COVERED = 0.85
"""Least part of one side's area that faces the other side."""
_HELD = 0.25
"""Largest relative difference of the volume behind one side from the mesh's: a handle or a foot is more."""
_VOLUME = 0.03
"""Largest relative difference between the volumes of prisms and mesh. Frequencies go with the thickness."""
_EVEN_VOLUME = 0.05
"""The same where the thickness is known: facets that cut across a curved wall leave out area, but no thickness. A tube
with facets of a third of its radius has 2.4 % less, and its lowest modes are 4 to 8 % too high."""
_MAX_DISTANT_PART = 0.02
"""Part of either surface that may be farther from the other than half the wall's thickness; than all of a known one."""
_INSIDE = 1e-5
"""How far behind a triangle rays start, in diagonals of the box around the mesh."""
_TRIANGLE = 1.2
"""Squared length of the sides over the sheet's area for each vertex, by trial; 1.15 for regular triangles."""
_MAX_LAYERS = 50
"""Layers at most."""
_MAX_ROUNDS = 100
"""Most rounds of averaging that fill in the thickness where no ray finds the other side."""


@dataclass(frozen=True, eq=False)
class Wall:
    """A closed mesh as a wall with two sides."""

    mesh: Trimesh
    """The closed mesh."""
    sheet: Trimesh
    """The larger side."""
    thickness: float
    """Meters; the mean of an uneven wall."""
    even: bool = False
    """Whether the thickness is known to be the same everywhere."""

    def length(self, dofs: int) -> float:
        """Return the sides' length along the wall, meters, of prisms with about so many degrees of freedom."""

        # Each vertex of the sheet has 4 nodes on each of 2 layers + 1 levels, and two triangles.
        def needed(layers: int) -> float:
            return math.sqrt(_TRIANGLE * 12.0 * (2 * layers + 1) * self.sheet.area / dofs)

        layers = 1
        while layers < _MAX_LAYERS - 1 and self._layers(needed(layers)) > layers:
            layers += 1
        return needed(layers)

    def _layers(self, length: float) -> int:
        """Return how many layers make prisms no higher than their sides are long."""
        return max(1, math.ceil(self.thickness / length)) if length else 1

    def solid(self, length: float) -> Solid:
        """Return prisms with sides of about `length` meters along the wall.

        Raises SimulationError where they do not fill the mesh.
        """
        return self.solids(length)(self.thickness)

    def solids(self, length: float) -> Callable[[float], Solid]:
        """Return what makes such prisms of another mean thickness, meters, behind the larger side.

        Raises SimulationError where those of the mesh's do not fill it; what it returns does where prisms fold.
        """
        coarse = remeshed(self.sheet, length)
        thickness = np.full(len(coarse.vertices), self.thickness) if self.even else self._thickness_at(coarse)

        def scaled(mean: float) -> Solid:
            assert thickness is not None
            solid = prisms(coarse, mean / self.thickness * thickness, layers=self._layers(length))
            if solid is None:
                wanted, got = "less than the mesh's radius of curvature", f"{1000 * mean:.2g} mm"
                raise SimulationError.expected(wanted, mean, got=got, name="thickness", advice="use a thinner wall")
            return solid

        if thickness is None or not self._fills(scaled(self.thickness)):
            wanted, got = "prisms that fill the mesh", f"gaps with prisms of {1000 * length:.2g} mm"
            raise SimulationError.expected(wanted, length, got=got, name="length", advice="make them finer")
        return scaled

    def _thickness_at(self, sheet: Trimesh) -> Float64[np.ndarray, " points"] | None:
        """Return the distance to the other side behind each vertex of a sheet, filled in from neighbors at rims."""
        reach, cosine, _ = _behind(self.mesh, sheet.vertices, sheet.vertex_normals)
        known = (cosine < _OPPOSITE) & (reach < _THICKER * self.thickness)
        joined = adjacency(sheet)
        values = np.where(known, reach, 0.0)
        for _ in range(_MAX_ROUNDS):
            if known.all():
                return values
            near = joined @ known.astype(float)
            new = ~known & (near > 0)
            values[new] = (joined @ np.where(known, values, 0.0))[new] / near[new]
            known = known | new
        return None

    def _fills(self, solid: Solid) -> bool:
        """Return whether prisms have the mesh's volume, and their surface is the mesh."""
        volume, away = (_EVEN_VOLUME, 1.0) if self.even else (_VOLUME, 0.5)
        if abs(solid.volume / self.mesh.volume - 1.0) > volume:
            return False
        outside = Trimesh(solid.points.numpy(), solid.boundary.numpy(), process=False)
        distances = (
            ClosestPoints(one.triangles)(even_points(other)).distances
            for one, other in ((outside, self.mesh), (self.mesh, outside))
        )
        return all(float((each > away * self.thickness).mean()) <= _MAX_DISTANT_PART for each in distances)


def wall_of(mesh: Trimesh, thickness: float | None = None) -> Wall | None:
    """Return a closed mesh as a wall, or as a block between two opposite sides; None where it is neither.

    `Wall.solid` finds out whether prisms between the sides fill it. `thickness` states that of an even wall, meters.
    """
    # Sides are found over edges of two triangles each.
    if not mesh.is_watertight or mesh.volume <= 0.0:
        return None
    areas = mesh.area_faces
    reach, cosine, behind = _behind(mesh, mesh.triangles_center, mesh.face_normals)
    facing = (cosine < _OPPOSITE) & (reach < _THICKER * 2.0 * mesh.volume / mesh.area)
    if not facing.any():
        return None
    label = _sides(mesh, facing)
    side = label == np.bincount(label[facing], weights=areas[facing]).argmax()
    covered = side & ~side[behind]
    held = float(areas[covered] @ reach[covered])
    if areas[covered].sum() < _COVERED * areas[side].sum() or abs(held / mesh.volume - 1.0) > _HELD:
        return None
    sheet = mesh_of(mesh.vertices, mesh.faces[side])
    if thickness is not None:
        return Wall(mesh, sheet, thickness, even=True)
    return Wall(mesh, sheet, float(np.average(reach[side], weights=areas[side])))


def _sides(mesh: Trimesh, facing: Bool[np.ndarray, " faces"]) -> Int[np.ndarray, " faces"]:
    """Return the number of the smooth connected part of the triangles `facing` that each is in; -1 for the others."""
    pairs = mesh.face_adjacency
    smooth = (mesh.face_normals[pairs[:, 0]] * mesh.face_normals[pairs[:, 1]]).sum(axis=1) > _CREASE
    return np.where(facing, components(pairs[smooth & facing[pairs].all(axis=1)], len(mesh.faces)), -1)


def _behind(
    mesh: Trimesh, places: Float64[np.ndarray, "places 3"], normals: Float64[np.ndarray, "places 3"]
) -> tuple[Float64[np.ndarray, " places"], Float64[np.ndarray, " places"], Int[np.ndarray, " places"]]:
    """Return the distance against the normals to the next triangle, the cosine of its normal, and its row.

    The distance is infinite where there is none, and the cosine 1.
    """
    rows, reach = RayCaster(mesh.triangles)(places, -normals, lead=_INSIDE)
    return reach, np.where(rows >= 0, (normals * mesh.face_normals[rows]).sum(axis=1), 1.0), rows
