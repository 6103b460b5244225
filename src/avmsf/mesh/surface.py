"""The object's shape, as triangles or as points; points all over it, and the part that contacts lie on."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, Seed, as_vectors, generator_of
from avmsf._utils.caching import content_digest
from avmsf.errors import ArrayError, CaptureError
from avmsf.mesh.points import connected_parts

SurfaceKind = Literal["ply", "obj", "glb"]
"""Formats that surfaces are written in."""
MOST_POINTS = 20_000
"""Points on the triangles of a surface."""
_ELSEWHERE = 0.1
"""Part of the contacts up to which those nearest to another part of a surface count as single mistakes."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles, or points alone."""

    vertices: Float[Tensor, "points 3"]
    """Object frame, meters."""
    faces: Int[Tensor, "faces 3"]
    """Rows of `vertices` at the corners of each triangle; no rows for a point cloud."""

    @classmethod
    def of(cls, vertices: ArrayLike, faces: ArrayLike = ()) -> "Surface":
        """Return the surface of vertices in meters, [points, 3], and triangles, [faces, 3]; points alone without these.

        Raises ArrayError for other shapes, for vertices that are not finite and for corners that are no vertices.
        """
        places = as_vectors(vertices, "vertices").float()
        given = as_vectors(faces, "faces") if len(faces) else torch.zeros(0, 3)
        corners = given.long()
        wrong = torch.nonzero(((corners != given) | (corners < 0) | (corners >= len(places))).any(1)).flatten()
        if len(wrong):
            row = int(wrong[0])
            wanted, found = f"indices of vertices, 0 to {len(places) - 1}", given[row].tolist()
            raise ArrayError.expected(wanted, found, name="faces", row=row)
        return cls(places, corners)

    @classmethod
    def read(cls, path: str | Path, *, meters: float = 1.0) -> "Surface":
        """Read a mesh or a point cloud whose coordinates count `meters` each; vertices keep the file's order.

        A scene of several parts becomes one surface. `CaptureError` as `load_mesh`, and where it holds no points.
        """
        # Imports trimesh, which takes half a second and what reads no mesh does without.
        from avmsf.mesh.io import load_parts

        path = Path(path)
        vertices, faces, count = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)], 0
        for part in load_parts(path):
            points = np.asarray(getattr(part, "vertices", np.zeros((0, 3))), dtype=np.float64)
            vertices.append(points)
            faces.append(np.asarray(getattr(part, "faces", np.zeros((0, 3))), dtype=np.int64).reshape(-1, 3) + count)
            count += len(points)
        if not count:
            raise CaptureError.expected("points", 0, got="none", file=path, advice="export the surface again")
        joined = (np.concatenate(vertices) * meters).astype(np.float32)
        return cls(torch.from_numpy(joined), torch.from_numpy(np.concatenate(faces)))

    def used(self) -> "Surface":
        """Return it without vertices of no triangle, such as those of a table that was deleted by its triangles."""
        rows, corners = torch.unique(self.faces, return_inverse=True)
        return Surface(self.vertices[rows], corners) if 0 < len(rows) < len(self.vertices) else self

    def write(self, path: str | Path, *, kind: SurfaceKind | None = None) -> None:
        """Write it in meters: as a binary PLY, which holds float32 coordinates to the last bit, as OBJ or as GLB.

        Without a `kind` by the name's ending, as PLY where it has none. Raises CaptureError for another ending.
        """
        import trimesh

        path = Path(path)
        kind = kind or cast("SurfaceKind", path.suffix.lower()[1:] or "ply")
        if kind not in get_args(SurfaceKind):
            wanted = f"a name that ends in .{', .'.join(get_args(SurfaceKind))}, or kind="
            raise CaptureError.expected(wanted, kind, file=path, name="kind")
        vertices, faces = self.vertices.numpy(), self.faces.numpy()
        cloud = not len(faces)
        shape = trimesh.PointCloud(vertices) if cloud else trimesh.Trimesh(vertices, faces, process=False)  # type: ignore[no-untyped-call]
        shape.export(path, file_type=kind)

    def digest(self) -> str:
        """Return a digest of the vertices and triangles."""
        return content_digest(self.vertices.double(), self.faces.long())

    def __repr__(self) -> str:
        size = " x ".join(f"{side:.3g}" for side in (self.vertices.amax(0) - self.vertices.amin(0)).tolist())
        return f"Surface({len(self.vertices)} vertices, {len(self.faces)} triangles, {size} m)"


def sample_surface(surface: Surface, count: int, *, seed: Seed) -> Float[Tensor, "points 3"]:
    """Draw `count` points from the triangles, evenly by area, in the vertices' dtype.

    Raises CaptureError for a surface without area, from which no point can be drawn.
    """
    # Takes half a second to import, which what reads no mesh does without.
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices.double().cpu().numpy(), surface.faces.cpu().numpy(), process=False)
    if not (math.isfinite(mesh.area) and mesh.area > 0.0):
        got = f"{mesh.area:g} m² of {len(surface.vertices)} vertices, {len(surface.faces)} faces"
        raise CaptureError.expected("triangles with an area", float(mesh.area), got=got, name="surface")
    number = int(torch.randint(2**31 - 1, (1,), generator=generator_of(seed)))
    places = trimesh.sample.sample_surface(mesh, count, seed=number)[0]
    return torch.from_numpy(np.asarray(places)).to(surface.vertices)


def surface_points(surface: Surface, *, count: int = MOST_POINTS) -> Float[Tensor, "points 3"]:
    """Return points all over a surface, always the same: `count` on its triangles, evenly by area, and its vertices."""
    import trimesh

    vertices = surface.vertices.double()
    mesh = trimesh.Trimesh(vertices.numpy(), surface.faces.numpy(), process=False)
    if not mesh.area > 0:
        return vertices
    return torch.cat([torch.from_numpy(np.array(trimesh.sample.sample_surface(mesh, count, seed=0)[0])), vertices])


def contacted_part(surface: Surface, contacts: Float[Tensor, "contacts 3"]) -> tuple[Surface, list[float]]:
    """Return a surface without connected parts larger than the one that contacts lie on, such as a table.

    The second value is the areas in square meters, of the part that is kept and of those left out; empty where the
    contacts lie on the largest or on several.
    """
    if not len(surface.faces) or not len(contacts):
        return surface, []
    import trimesh
    from scipy.spatial import cKDTree

    mesh = trimesh.Trimesh(surface.vertices.double().numpy(), surface.faces.numpy(), process=False)
    rows = np.unique(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = np.concatenate([rows[:, [0, 1]], rows[:, [1, 2]]])
    parts_of = connected_parts(edges, int(rows.max()) + 1)
    label = parts_of[rows[:, 0]]
    if not label.any() or not mesh.area > 0:
        return surface, []
    points, faces = trimesh.sample.sample_surface(mesh, MOST_POINTS, seed=0)
    parts = label[faces[cKDTree(points).query(contacts.double().numpy())[1]]]
    part, areas = int(np.bincount(parts).argmax()), np.bincount(label, weights=mesh.area_faces)
    left = areas > areas[part]
    if not left.any() or np.mean(parts != part) > _ELSEWHERE:
        return surface, []
    kept = Surface(surface.vertices, surface.faces[torch.from_numpy(~left[label])])
    return kept.used(), [float(areas[part]), *map(float, areas[left])]
