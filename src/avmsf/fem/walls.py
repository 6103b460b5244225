"""Walls as layers of prisms: behind a surface, or between the two sides that a closed mesh shows.

One layer of second-order elements bends as a shell does, so that the prisms may be many times as wide as the wall is
thick, where tetrahedra of even shape would have to be as small as the wall.

Tetrahedra that fill a closed mesh without regard to its sides lock: their outer and inner facets do not lie opposite to
each other, so that the wall cannot bend without stretching (docs/decisions/thin-walls.md).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int
from trimesh import Trimesh

from avmsf.errors import SimulationError
from avmsf.fem.meshing import oriented, weld
from avmsf.fem.remeshing import adjacency, boundary_edges, even_points, mesh_of, remeshed
from avmsf.fem.solid import Solid, prism_cells
from avmsf.fem.tetrahedra import fill
from avmsf.mesh.points import connected_parts, unit
from avmsf.mesh.queries import ClosestPoints, RayCaster
from avmsf.mesh.surface import Surface


@dataclass(frozen=True)
class Tolerances:
    """What a wall may be, and what a closed mesh is taken to be a wall by."""

    max_turns: int = 30  # times that the wall is turned and thinned where prisms are folded
    tilt: float = 0.1  # how far a folded triangle turns the wall towards its own inside, each time
    thinning: float = 0.85  # factor on the wall's thickness at folded prisms, each time
    max_slope: float = 0.3  # that the thickness grows along an edge over the edge's length, where it was thinned
    max_spared_area: float = 0.1  # part at which the wall may be folded, or thinner than half of what was asked for
    min_prism_volume: float = 0.05  # of a tetrahedron over a third of a straight prism, below which that is folded
    max_opposite_cosine: float = -0.8  # between the normals of the two sides
    min_smooth_cosine: float = 0.7  # of the angle between neighboring triangles of one side
    max_reach: float = 2.5  # distance to the other side over twice the volume by area; beyond is a rim or a lump
    min_covered_area: float = 0.85  # part of one side's area that faces the other side
    max_held_error: float = 0.25  # relative, of the volume behind one side: a handle or a foot is more
    max_volume_error: float = 0.03  # relative, of the prisms' volume: frequencies go with the thickness
    # The same where the thickness is known: facets that cut across a curved wall leave out area, but no thickness. A
    # tube with facets of a third of its radius has 2.4 % less, and its lowest modes are 4 to 8 % too high.
    max_even_volume_error: float = 0.05
    max_distant_part: float = 0.02  # of either surface, farther from the other than half an unknown thickness
    ray_lead: float = 1e-5  # how far behind a triangle rays start, in diagonals of the box around the mesh
    triangle_ratio: float = 1.2  # squared sides over the sheet's area for each vertex, by trial; 1.15 if regular
    max_layers: int = 50
    max_rounds: int = 100  # of averaging, which fills in the thickness where no ray finds the other side


TOLERANCES = Tolerances()


def shell(surface: Surface, *, thickness: float, detail: float = 0.04) -> Solid:
    """Return the wall of `thickness` meters that lies inwards of a surface, against its triangles' normals.

    It is an open sheet, whose rims are closed straight through the wall, or the outer surface of a hollow body.
    It is remeshed to triangles with sides of about `detail` times its size, the diagonal of the box around it. Where it
    bends more tightly than the wall is thick the wall is thinner, on a tenth of the surface at most. Where even that
    folds prisms, as on scans with creases, both sides of the wall are filled as `fill` does, which is slower.

    Raises SimulationError for a surface without triangles or area, one whose triangles face different ways, a
    thickness too large for how tightly the surface bends, and a closed surface that holds less than the wall would.
    """
    mesh = oriented(weld(surface))
    if not len(boundary_edges(mesh)) and mesh.area * thickness > abs(mesh.volume):
        middle = 0.5 * abs(mesh.volume) / mesh.area
        wanted, got = f"less than the {4 * middle:.2g} m of the closed surface on average", f"{thickness:.3g} m"
        advice = f"use a solid body (0 m), or a wall of {middle:.1g} m"
        raise SimulationError.expected(wanted, thickness, got=got, name="thickness", advice=advice)
    coarse = remeshed(mesh, detail * mesh.scale)
    folded = float(_folded(coarse, -thickness * coarse.vertex_normals) @ coarse.area_faces / coarse.area)
    if folded > TOLERANCES.max_spared_area:
        wanted, advice = "less than the surface's radius of curvature", "try half of it, or smooth the mesh"
        raise SimulationError.expected(wanted, thickness, got=f"{thickness:g} m", name="thickness", advice=advice)
    solid = prisms(coarse, np.full(len(coarse.vertices), thickness))
    return solid if solid is not None else fill(_both_sides(coarse, thickness), detail=detail)


def prisms(mesh: Trimesh, thickness: Float64[np.ndarray, " points"], *, layers: int = 1) -> Solid | None:
    """Return a wall of this thickness at each vertex inwards of a mesh, or None where some prisms stay folded."""
    offsets = _offsets(mesh, thickness)
    if offsets is None:
        return None
    count = len(mesh.vertices)
    points = np.concatenate([mesh.vertices + layer / layers * offsets for layer in range(layers + 1)])
    cells = np.concatenate([_prisms(mesh).reshape(-1, 4) + layer * count for layer in range(layers)])
    return Solid.build(torch.from_numpy(points), torch.from_numpy(cells))


def _offsets(mesh: Trimesh, thickness: Float64[np.ndarray, " points"]) -> Float64[np.ndarray, "points 3"] | None:
    """Return the way from each vertex through the wall, or None where some prisms stay folded."""
    faces = np.asarray(mesh.faces)
    directions, lengths = -mesh.vertex_normals, thickness.copy()
    ends = np.concatenate([mesh.edges, mesh.edges[:, ::-1]])
    tolerance = TOLERANCES.max_slope * np.linalg.norm(np.diff(mesh.vertices[ends], axis=1)[:, 0], axis=1)
    for _ in range(TOLERANCES.max_turns):
        folded = _folded(mesh, lengths[:, None] * directions)
        if not folded.any():
            thin = (lengths[faces].mean(axis=1) < 0.5 * thickness[faces].mean(axis=1)) @ mesh.area_faces
            return lengths[:, None] * directions if thin <= TOLERANCES.max_spared_area * mesh.area else None
        # Where there is a direction that all triangles around a vertex see from outside, this finds one in the end.
        np.add.at(directions, faces[folded], -TOLERANCES.tilt * mesh.face_normals[folded][:, None])
        directions = unit(directions)
        lengths[np.unique(faces[folded])] *= TOLERANCES.thinning
        # A wall that thins within one triangle would fold the next.
        np.minimum.at(lengths, ends[:, 0], lengths[ends[:, 1]] + tolerance)
    return None


def _both_sides(mesh: Trimesh, thickness: float) -> Surface:
    """Return the closed surface of a wall: the mesh, its like inside turned round, and strips along the rims."""
    start, end = boundary_edges(mesh).T
    inner = len(mesh.vertices)
    strips = [np.stack([end, start, start + inner], axis=1), np.stack([end, start + inner, end + inner], axis=1)]
    faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1] + inner, *strips])
    points = np.concatenate([mesh.vertices, mesh.vertices - thickness * mesh.vertex_normals])
    return Surface(torch.from_numpy(points).float(), torch.from_numpy(faces))


def _folded(mesh: Trimesh, offsets: np.ndarray) -> np.ndarray:
    """Return which triangles' prisms hold a tetrahedron that is flat or inside out, [faces]."""
    points = np.concatenate([mesh.vertices, mesh.vertices + offsets])
    corners = points[_prisms(mesh)]
    volumes = np.linalg.det(corners[:, :, 1:] - corners[:, :, :1]) / 6.0
    straight = mesh.area_faces * np.linalg.norm(offsets, axis=1)[mesh.faces].mean(axis=1) / 3.0
    return (volumes <= TOLERANCES.min_prism_volume * straight[:, None]).any(axis=1)


def _prisms(mesh: Trimesh) -> Int[np.ndarray, "triangles 3 4"]:
    """Return the tetrahedra of prisms from the vertices to as many points behind them."""
    outer = np.arange(len(mesh.vertices))
    # Counter-clockwise seen from inside.
    return prism_cells(mesh.faces[:, ::-1], outer, outer, outer + len(outer))


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
            return math.sqrt(TOLERANCES.triangle_ratio * 12.0 * (2 * layers + 1) * self.sheet.area / dofs)

        layers = 1
        while layers < TOLERANCES.max_layers - 1 and self._layers(needed(layers)) > layers:
            layers += 1
        return needed(layers)

    def _layers(self, length: float) -> int:
        """Return how many layers make prisms no higher than their sides are long."""
        return max(1, math.ceil(self.thickness / length)) if length else 1

    def solids(self, length: float) -> Callable[[float], Solid]:
        """Return what makes prisms of a mean thickness, meters, with sides of about `length` meters along the wall.

        They lie behind the larger side. Raises SimulationError where those of the wall's own thickness do not fill the
        mesh; what it returns does where prisms fold.
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
        known = (cosine < TOLERANCES.max_opposite_cosine) & (reach < TOLERANCES.max_reach * self.thickness)
        joined = adjacency(sheet)
        values = np.where(known, reach, 0.0)
        for _ in range(TOLERANCES.max_rounds):
            if known.all():
                return values
            near = joined @ known.astype(float)
            new = ~known & (near > 0)
            values[new] = (joined @ np.where(known, values, 0.0))[new] / near[new]
            known = known | new
        return None

    def _fills(self, solid: Solid) -> bool:
        """Return whether prisms have the mesh's volume, and their surface is the mesh."""
        volume, away = (TOLERANCES.max_even_volume_error, 1.0) if self.even else (TOLERANCES.max_volume_error, 0.5)
        if abs(solid.volume / self.mesh.volume - 1.0) > volume:
            return False
        outside = Trimesh(solid.points.numpy(), solid.boundary.numpy(), process=False)
        distances = (
            ClosestPoints(one.triangles)(even_points(other)).distances
            for one, other in ((outside, self.mesh), (self.mesh, outside))
        )
        return all(float((each > away * self.thickness).mean()) <= TOLERANCES.max_distant_part for each in distances)


def wall_of(mesh: Trimesh, thickness: float | None = None) -> Wall | None:
    """Return a closed mesh as a wall, or as a block between two opposite sides; None where it is neither.

    `Wall.solids` finds out whether prisms between the sides fill it. `thickness` states that of an even wall, meters.
    """
    # Sides are found over edges of two triangles each.
    if not mesh.is_watertight or mesh.volume <= 0.0:
        return None
    areas = mesh.area_faces
    reach, cosine, behind = _behind(mesh, mesh.triangles_center, mesh.face_normals)
    facing = (cosine < TOLERANCES.max_opposite_cosine) & (reach < TOLERANCES.max_reach * 2.0 * mesh.volume / mesh.area)
    if not facing.any():
        return None
    label = _sides(mesh, facing)
    side = label == np.bincount(label[facing], weights=areas[facing]).argmax()
    covered = side & ~side[behind]
    held_error = abs(float(areas[covered] @ reach[covered]) / mesh.volume - 1.0)
    least = TOLERANCES.min_covered_area * areas[side].sum()
    if areas[covered].sum() < least or held_error > TOLERANCES.max_held_error:
        return None
    sheet = mesh_of(mesh.vertices, mesh.faces[side])
    if thickness is not None:
        return Wall(mesh, sheet, thickness, even=True)
    return Wall(mesh, sheet, float(np.average(reach[side], weights=areas[side])))


def _sides(mesh: Trimesh, facing: Bool[np.ndarray, " faces"]) -> Int[np.ndarray, " faces"]:
    """Return the number of the smooth connected part of the triangles `facing` that each is in; -1 for the others."""
    pairs = mesh.face_adjacency
    cosine = (mesh.face_normals[pairs[:, 0]] * mesh.face_normals[pairs[:, 1]]).sum(axis=1)
    joined = pairs[(cosine > TOLERANCES.min_smooth_cosine) & facing[pairs].all(axis=1)]
    return np.where(facing, connected_parts(joined, len(mesh.faces)), -1)


def _behind(
    mesh: Trimesh, places: Float64[np.ndarray, "places 3"], normals: Float64[np.ndarray, "places 3"]
) -> tuple[Float64[np.ndarray, " places"], Float64[np.ndarray, " places"], Int[np.ndarray, " places"]]:
    """Return the distance against the normals to the next triangle, the cosine of its normal, and its row.

    The distance is infinite where there is none, and the cosine 1.
    """
    rows, reach, _ = RayCaster(mesh.triangles)(places, -normals, lead=TOLERANCES.ray_lead)
    return reach, np.where(rows >= 0, (normals * mesh.face_normals[rows]).sum(axis=1), 1.0), rows
