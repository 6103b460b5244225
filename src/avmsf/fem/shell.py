"""A surface given a wall: a layer of prisms inwards from it, each of them three tetrahedra.

One layer of second-order elements bends as a shell does, so that the prisms may be many times as wide as the wall is
thick, where tetrahedra of even shape would have to be as small as the wall.
"""

import numpy as np
import torch
from jaxtyping import Float64, Int
from trimesh import Trimesh

from avmsf.errors import SimulationError
from avmsf.fem.remeshing import boundary_edges, oriented, remeshed, unit, weld
from avmsf.fem.solid import Solid, prism_cells
from avmsf.fem.tetrahedra import expect_detail, fill
from avmsf.mesh.surface import Surface

_STEPS = 30
"""Most times that the wall is turned and thinned where prisms are folded."""
_TILT = 0.1
"""How far a folded triangle turns the wall towards its own inside, each time."""
_THINNING = 0.85
"""Factor on the wall's thickness at folded prisms, each time."""
_SLOPE = 0.3
"""Most that the thickness grows along an edge over the edge's length, where it was thinned."""
_SPARED = 0.1
"""Part of the surface at which the wall may be folded, or thinner than half of what was asked for."""
_FLATTEST = 0.05
"""Volume of a tetrahedron over that of a third of a straight prism, below which the prism is folded."""


def shell(surface: Surface, *, thickness: float, detail: float = 0.04) -> Solid:
    """Return the wall of `thickness` meters that lies inwards of a surface, against its triangles' normals.

    The surface is an open sheet, whose rims are closed straight through the wall, or the outer skin of a hollow body.
    It is remeshed to triangles with sides of about `detail` times its size, the diagonal of the box around it. Where it
    bends more tightly than the wall is thick the wall is thinner, on a tenth of the surface at most. Where even that
    folds prisms, as on scans with creases, both sides of the wall are filled as `fill` does, which is slower.

    Raises SimulationError for a surface without triangles or area, one whose triangles face different ways, a
    thickness that is not positive or too large for how tightly the surface bends, and a closed skin that holds less
    than the wall would.
    """
    if not 0 < thickness < np.inf:
        raise SimulationError.expected("more than 0 m", thickness, name="thickness")
    expect_detail(detail)
    mesh = oriented(weld(surface))
    if not len(boundary_edges(mesh)) and mesh.area * thickness > abs(mesh.volume):
        middle = 0.5 * abs(mesh.volume) / mesh.area
        wanted, got = f"less than the {4 * middle:.2g} m of the closed surface on average", f"{thickness:.3g} m"
        advice = f"use a solid body (0 m), or a wall of {middle:.1g} m"
        raise SimulationError.expected(wanted, thickness, got=got, name="thickness", advice=advice)
    coarse = remeshed(mesh, detail * mesh.scale)
    if _folded_part(coarse, thickness) > _SPARED:
        fitting = (thickness * 0.5**step for step in range(1, 8))
        suggested = next((each for each in fitting if _folded_part(coarse, each) <= _SPARED), None)
        hint = "smooth the mesh" if suggested is None else f"try thickness={suggested:.2g}, or smooth the mesh"
        wanted, got = "less than the surface's radius of curvature", f"{thickness:g} m"
        raise SimulationError.expected(wanted, thickness, got=got, name="thickness", advice=hint)
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
    tolerance = _SLOPE * np.linalg.norm(np.diff(mesh.vertices[ends], axis=1)[:, 0], axis=1)
    for _ in range(_STEPS):
        folded = _folded(mesh, lengths[:, None] * directions)
        if not folded.any():
            thin = lengths[faces].mean(axis=1) < 0.5 * thickness[faces].mean(axis=1)
            return lengths[:, None] * directions if thin @ mesh.area_faces <= _SPARED * mesh.area else None
        # Where there is a direction that all triangles around a vertex see from outside, this finds one in the end.
        np.add.at(directions, faces[folded], -_TILT * mesh.face_normals[folded][:, None])
        directions = unit(directions)
        lengths[np.unique(faces[folded])] *= _THINNING
        # A wall that thins within one triangle would fold the next.
        np.minimum.at(lengths, ends[:, 0], lengths[ends[:, 1]] + tolerance)
    return None


def _folded_part(mesh: Trimesh, thickness: float) -> float:
    """Return the part of the area at which a wall of even thickness folds."""
    return float(_folded(mesh, -thickness * mesh.vertex_normals) @ mesh.area_faces / mesh.area)


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
    return (volumes <= _FLATTEST * straight[:, None]).any(axis=1)


def _prisms(mesh: Trimesh) -> Int[np.ndarray, "triangles 3 4"]:
    """Return the tetrahedra of prisms from the vertices to as many points behind them."""
    outer = np.arange(len(mesh.vertices))
    # Counter-clockwise seen from inside.
    return prism_cells(mesh.faces[:, ::-1], outer, outer, outer + len(outer))
