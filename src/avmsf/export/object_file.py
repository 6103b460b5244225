"""The object that a page shows: a mesh, Gaussians, or the field's points."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import fast_simplification
import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor
from trimesh.visual import ColorVisuals

from avmsf.errors import ExportError
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.io import MAX_BYTES, load_mesh
from avmsf.mesh.surface import Surface

MOST_FACES = 200_000
"""Triangles that a browser displays and picks quickly; larger meshes are reduced."""
_ALIKE = 3.0
"""Ratio of the sizes of object and field above which their units differ."""


@dataclass(frozen=True, eq=False)
class ObjectFile:
    """The file of an object's geometry."""

    kind: Literal["mesh", "gaussians", "points"]
    name: str | None = None
    """Name of the file; None for points, which are those of the field."""
    content: bytes = b""
    remarks: tuple[str, ...] = ()
    """Notes on differences from the given file."""


def read_object(
    source: Path | Surface | None, points: Float[Tensor, "points 3"], *, meters: float = 1.0, most: int = MOST_FACES
) -> ObjectFile:
    """Return an object for a field at `points`: a mesh as `.glb`, Gaussians as they are, or None.

    A file's coordinates count `meters` each; Gaussians are in meters. Meshes of more than `most` triangles are reduced.
    Raises `ExportError` for a file that is missing, not a mesh, huge, or not in the field's unit.
    """
    if source is None:
        return ObjectFile("points")
    if isinstance(source, Surface):
        mesh = trimesh.Trimesh(source.vertices.numpy(), source.faces.numpy(), process=False)
        return _shown(trimesh.Scene([mesh]), points, None, most)
    expect_readable(source)
    if source.suffix.lower() == ".ply" and holds_gaussians(source):
        expect_alike(read_splats(source).centers.numpy(), points, source)
        return ObjectFile("gaussians", "object.ply", source.read_bytes())
    scene = load_mesh(source, raising=ExportError)
    scene.apply_scale(meters)  # type: ignore[no-untyped-call]
    return _shown(scene, points, source, most)


def expect_readable(path: Path) -> None:
    """Raise `ExportError` where there is no such file, or one too large to be read: `load_mesh` bounds meshes alone."""
    if not path.is_file():
        raise ExportError(
            f"{path}: expected a mesh or a .ply of Gaussians, got no such file; check the name", file=path
        )
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ExportError(
            f"{path}: expected a mesh of at most {MAX_BYTES >> 20} MiB, got {size >> 20}; reduce it first",
            file=path,
            name="size",
            value=size,
        )


def holds_gaussians(path: Path) -> bool:
    """Return whether a .ply's header has the properties of Gaussians."""
    with path.open("rb") as file:
        header, _, _ = file.read(1 << 16).partition(b"end_header")
    return b"scale_0" in header and b"rot_0" in header


def _shown(scene: trimesh.Scene, points: Float[Tensor, "points 3"], path: Path | None, most: int) -> ObjectFile:
    what = path or "the surface"
    meshes = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    faces = sum(len(mesh.faces) for mesh in meshes)
    if not meshes:
        return ObjectFile("points", remarks=(f"{what} has no triangles: the field's points are shown",))
    places = np.concatenate([np.asarray(mesh.vertices, dtype=np.float64) for mesh in meshes])
    expect_alike(places, points, path)
    if faces <= most:
        return ObjectFile("mesh", "object.glb", _as_glb(scene))
    smaller = trimesh.Scene([reduced(mesh, most / faces) for mesh in meshes])
    left = sum(len(mesh.faces) for mesh in smaller.geometry.values())
    remark = f"{what} has {faces:,} triangles, too many for a browser: {left:,} are shown, without its textures"
    return ObjectFile("mesh", "object.glb", _as_glb(smaller), (remark,))


def _as_glb(scene: trimesh.Scene) -> bytes:
    content = scene.export(file_type="glb")  # type: ignore[no-untyped-call]
    assert isinstance(content, bytes)
    return content


def reduced(mesh: trimesh.Trimesh, share: float) -> trimesh.Trimesh:
    """Return a mesh of such a share of the triangles, with vertex colors but no textures."""
    # Faces without shared corners cannot be merged, and many files have no others.
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    target = max(4, math.floor(share * len(mesh.faces)))
    vertices, faces = fast_simplification.simplify(
        np.asarray(merged.vertices, np.float32), np.asarray(merged.faces), target_count=target
    )
    small = trimesh.Trimesh(vertices, faces, process=False)
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        _, rows = cKDTree(mesh.vertices).query(vertices)
        small.visual = ColorVisuals(small, vertex_colors=mesh.visual.vertex_colors[rows])
    return small


def expect_alike(places: Float[np.ndarray, "places 3"], points: Float[Tensor, "points 3"], path: Path | None) -> None:
    """Raise `ExportError` for an object, read from `path`, of another size or position than the field."""
    what = path or "the surface"
    own = points.double().numpy()
    size, expected = np.ptp(places, axis=0), np.ptp(own, axis=0)
    ratio = float(np.linalg.norm(size) / max(float(np.linalg.norm(expected)), 1e-12))
    apart = float(np.linalg.norm(places.min(axis=0) + size / 2 - own.min(axis=0) - expected / 2))
    if not 1 / _ALIKE < ratio < _ALIKE:
        raise ExportError(
            f"{what}: expected an object of the field's size, {np.linalg.norm(expected):.3g} m, got {ratio:.4g} times "
            "this; give the unit of its coordinates, or name the field's object",
            file=path,
            name="size",
            value=ratio,
        )
    if apart > float(np.linalg.norm(expected)):
        raise ExportError(
            f"{what}: expected the object at the field's points, got its center {apart:.3g} m away; name a file in the "
            "frame of the capture",
            file=path,
            name="center",
            value=apart,
        )
