"""Geometry for viewers: triangles with colors, centers of Gaussians, or points."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor
from trimesh.visual import ColorVisuals

from avmsf.export.object_file import MOST_FACES, expect_alike, expect_readable, reduced
from avmsf.export.sampled_field import SampledField
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.initialize import ZEROTH
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh, read_textured_mesh


@dataclass(frozen=True, eq=False)
class Look:
    """Geometry to show: triangles with colors, or points."""

    vertices: Float[Tensor, "vertices 3"]
    """Object frame, meters."""
    faces: Int[Tensor, "faces 3"]
    """Rows of `vertices`; empty for points."""
    normals: Float[Tensor, "vertices 3"]
    """Outward unit normals."""
    colors: Float[Tensor, "vertices 3"] | None = None
    """Red, green, blue as displayed (sRGB), 0 to 1; None for gray."""

    @classmethod
    def of_points(cls, sampled: SampledField) -> "Look":
        """Return the field's points."""
        return cls(sampled.points, torch.zeros(0, 3, dtype=torch.int64), sampled.normals)

    @classmethod
    def of_mesh(cls, mesh: TexturedMesh) -> "Look":
        """Return a mesh; a vertex is split if its normal or color differs between faces.

        Textures become vertex colors.
        """
        corners = torch.cat([mesh.vertices[mesh.faces], mesh.normals, _corner_colors(mesh)], dim=2).reshape(-1, 9)
        table, rows = np.unique(corners.numpy(), axis=0, return_inverse=True)
        kept = torch.from_numpy(table).float()
        return cls(kept[:, :3], torch.from_numpy(rows.reshape(-1, 3)), kept[:, 3:6], kept[:, 6:])

    @classmethod
    def of_gaussians(cls, cloud: GaussianCloud, sampled: SampledField) -> "Look":
        """Return the centers of Gaussians in their colors."""
        colors = (0.5 + ZEROTH * cloud.harmonics[:, 0]).clamp(0.0, 1.0)
        normals = sampled.normals[sampled.nearest(cloud.centers)]
        return cls(cloud.centers, torch.zeros(0, 3, dtype=torch.int64), normals, colors)


def read_look(source: Path | Surface, sampled: SampledField, *, meters: float = 1.0) -> tuple[Look, tuple[str, ...]]:
    """Read a mesh whose coordinates count `meters` each, and notes on differences from the file.

    A `Surface` is in meters. Meshes of more than `MOST_FACES` triangles are reduced. Raises `ExportError` for one that
    is huge, or not in the field's unit, and `CaptureError` for a file that is not a mesh.
    """
    if isinstance(source, Surface):
        path, mesh = None, TexturedMesh.build(source.vertices, source.faces)
    else:
        expect_readable(source)
        path, mesh = source, read_textured_mesh(source, meters=meters)
    expect_alike(mesh.vertices.double().numpy(), sampled.points, path)
    faces = len(mesh.faces)
    if faces <= MOST_FACES:
        return Look.of_mesh(mesh), ()
    corners = mesh.vertices[mesh.faces].reshape(-1, 3).numpy()
    painted = (255.0 * _corner_colors(mesh)).round().byte().reshape(-1, 3).numpy()
    solid = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), vertex_colors=painted, process=False)
    small = reduced(solid, MOST_FACES / faces)
    assert isinstance(small.visual, ColorVisuals)
    corner_rows = torch.from_numpy(np.array(small.faces, dtype=np.int64))
    shown = torch.from_numpy(np.array(small.visual.vertex_colors[:, :3], dtype=np.float32)) / 255.0
    vertices = torch.from_numpy(np.array(small.vertices)).float()
    remark = f"{path or 'the surface'} has {faces:,} triangles, too many for a browser: {len(corner_rows):,} are shown"
    return Look.of_mesh(TexturedMesh.build(vertices, corner_rows, colors=shown[corner_rows])), (remark,)


def _corner_colors(mesh: TexturedMesh) -> Float[Tensor, "faces 3 3"]:
    """Return each corner's color times that of its texture there."""
    colors = mesh.colors.clone()
    for number, texture in enumerate(mesh.textures):
        chosen = mesh.materials == number
        height, width = texture.shape[:2]
        across, up = mesh.coordinates[chosen].unbind(2)
        column = (across.remainder(1.0) * width).long().clamp(max=width - 1)
        row = ((1.0 - up.remainder(1.0)) * height).long().clamp(0, height - 1)
        colors[chosen] *= texture[row, column].float() / 255.0
    return colors
