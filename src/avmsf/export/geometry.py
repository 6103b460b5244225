"""The object that a page shows: a mesh, Gaussians, or the field's points."""

import math
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor
from trimesh.visual import ColorVisuals

from avmsf.errors import ExportError
from avmsf.export.sampled_field import SampledField
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import holds_gaussians, read_splats
from avmsf.mesh.io import load_mesh
from avmsf.mesh.level_set import decimated
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh, read_textured_mesh

MAX_FACES = 200_000
"""Triangles that a browser displays and picks quickly; larger meshes are reduced."""
_MAX_SIZE_RATIO = 3.0
"""Ratio of the sizes of object and field above which their units differ."""


ObjectKind = Literal["mesh", "gaussians", "points"]


def read_object(
    source: str | Path | Surface | None, points: Float[Tensor, "points 3"], *, meters: float = 1.0
) -> tuple[ObjectKind, bytes, tuple[str, ...]]:
    """Return an object for a field at `points`: its kind, its file, and notes on differences from the given one.

    A mesh becomes a `.glb`, Gaussians stay as they are, and without either the field's points are shown. A file's
    coordinates count `meters` each; Gaussians are in meters. Meshes of more than `MAX_FACES` triangles are reduced.
    Raises `ExportError` for a file that is missing, not a mesh, a huge mesh, or not in the field's unit.
    """
    if source is None:
        return "points", b"", ()
    source = Path(source) if isinstance(source, str) else source
    if isinstance(source, Surface):
        scene = trimesh.Scene([trimesh.Trimesh(source.vertices.numpy(), source.faces.numpy(), process=False)])
    elif read_gaussians(source, points) is not None:
        return "gaussians", source.read_bytes(), ()
    else:
        scene = load_mesh(source, raising=ExportError)
        scene.apply_scale(meters)  # type: ignore[no-untyped-call]
    meshes = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not meshes:
        return "points", b"", (f"{_named(source)} has no triangles: the field's points are shown",)
    _check_fits(np.concatenate([np.asarray(mesh.vertices, dtype=np.float64) for mesh in meshes]), points, source)
    remarks: tuple[str, ...] = ()
    faces = sum(len(mesh.faces) for mesh in meshes)
    if faces > MAX_FACES:
        scene = trimesh.Scene([_reduced(mesh, MAX_FACES / faces) for mesh in meshes])
        left = sum(len(mesh.faces) for mesh in scene.geometry.values())
        remarks = (
            f"{_named(source)} has {faces:,} triangles, too many for a browser: {left:,} are shown, without textures",
        )
    content = scene.export(file_type="glb")  # type: ignore[no-untyped-call]
    assert isinstance(content, bytes)
    return "mesh", content, remarks


def read_gaussians(path: Path, points: Float[Tensor, "points 3"]) -> GaussianCloud | None:
    """Return the Gaussians of a `.ply`, in meters, for a field at `points`; None for another file, or none.

    Raises `ExportError` for Gaussians in another unit.
    """
    if not holds_gaussians(path):
        return None
    cloud = read_splats(path)
    _check_fits(cloud.centers.numpy(), points, path)
    return cloud


def _named(source: Path | Surface) -> Path | str:
    """Return what messages call an object."""
    return source if isinstance(source, Path) else "the surface"


def _reduced(mesh: trimesh.Trimesh, share: float) -> trimesh.Trimesh:
    """Return a mesh of such a share of the triangles, with vertex colors but no textures."""
    # Faces without shared corners cannot be merged, and many files have no others.
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    target = max(4, math.floor(share * len(mesh.faces)))
    vertices, faces = decimated(np.asarray(merged.vertices, np.float32), np.asarray(merged.faces), target)
    small = trimesh.Trimesh(vertices, faces, process=False)
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        _, rows = cKDTree(mesh.vertices).query(vertices)
        small.visual = ColorVisuals(small, vertex_colors=mesh.visual.vertex_colors[rows])
    return small


def _check_fits(
    places: Float[np.ndarray, "places 3"], points: Float[Tensor, "points 3"], source: Path | Surface
) -> None:
    """Raise `ExportError` for an object of another size or position than the field."""
    own, file = points.double().numpy(), _named(source)
    size, expected = np.ptp(places, axis=0), np.ptp(own, axis=0)
    length = float(np.linalg.norm(expected))
    ratio = float(np.linalg.norm(size) / max(length, 1e-12))
    apart = float(np.linalg.norm(places.min(axis=0) + size / 2 - own.min(axis=0) - expected / 2))
    if not 1 / _MAX_SIZE_RATIO < ratio < _MAX_SIZE_RATIO:
        wanted, got = f"an object of the field's size, {length:.3g} m", f"{ratio:.4g} times this"
        advice = "give the unit of its coordinates, or name the field's object"
        raise ExportError.expected(wanted, ratio, got=got, file=file, name="size", advice=advice)
    if apart > length:
        wanted, got = "the object at the field's points", f"its center {apart:.3g} m away"
        advice = "name a file in the frame of the capture"
        raise ExportError.expected(wanted, apart, got=got, file=file, name="center", advice=advice)


def read_vertices(
    source: str | Path | Surface | None, sampled: SampledField, *, meters: float = 1.0
) -> tuple[dict[str, Tensor], Path | None]:
    """Return the arrays of an object to show, by their names in glTF, and the file if it has Gaussians.

    `POSITION` (object frame, meters), outward unit `NORMAL`, `COLOR_0` as displayed (sRGB, 0 to 1), and `indices` of
    triangles. A mesh file's coordinates count `meters` each, and its textures become vertex colors; a `Surface` is in
    meters, as are Gaussians, of which the centers are shown; without a source the field's points are. Raises
    `ExportError` for one that is not in the field's unit, and `CaptureError` for a file that is no mesh, or a huge one.
    """
    if source is None:
        return {"POSITION": sampled.points, "NORMAL": sampled.normals}, None
    source = Path(source) if isinstance(source, str) else source
    if isinstance(source, Surface):
        mesh = TexturedMesh.plain(source)
    elif (cloud := read_gaussians(source, sampled.extent)) is not None:
        normals = sampled.normals[sampled.nearest(cloud.centers)]
        return {"POSITION": cloud.centers, "NORMAL": normals, "COLOR_0": cloud.colors}, source
    else:
        mesh = read_textured_mesh(source, meters=meters)
    _check_fits(mesh.vertices.double().numpy(), sampled.extent, source)
    # Vertices are split where normals or colors differ between faces.
    corners = torch.cat([mesh.vertices[mesh.faces], mesh.normals, mesh.corner_colors], dim=2).reshape(-1, 9)
    table, rows = np.unique(corners.numpy(), axis=0, return_inverse=True)
    position, normal, color = torch.split(torch.from_numpy(table).float(), 3, dim=1)
    return {"POSITION": position, "NORMAL": normal, "COLOR_0": color, "indices": torch.from_numpy(rows.ravel())}, None
