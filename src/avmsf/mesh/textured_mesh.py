"""A triangle mesh with its colors, as scanners and modelling programs write it: obj, ply, glb or stl."""

import math
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.io import check_area, check_corners, check_finite_vertices, load_parts
from avmsf.mesh.surface import Surface

GRAY = 0.7
"""Brightness of what has no color, 0 to 1."""
CREASE = 40.0
"""Degrees between a face and the mean of the faces around one of its corners, beyond which the corner is sharp.

A box's corner leans 55 degrees from each of its three sides, an edge at a right angle 45 from both.
"""


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangles with smooth normals and the colors of their surface, all given at the corners of each face.

    The color of a place is that of its texture times that of the mesh; what has no texture has a white one.
    """

    vertices: Float[Tensor, "points 3"]
    """Object frame, meters; no two in one place."""
    faces: Int[Tensor, "faces 3"]
    """Rows of `vertices` at the corners of each triangle."""
    normals: Float[Tensor, "faces 3 3"]
    """Unit normal at each corner, the same for all faces around it unless the edge is sharp."""
    colors: Float[Tensor, "faces 3 3"]
    """Red, green, blue at each corner as displayed (sRGB), 0 to 1."""
    coordinates: Float[Tensor, "faces 3 2"]
    """Place of each corner in its texture: u to the right and v up, each 0 to 1 over the image, which repeats."""
    materials: Int[Tensor, " faces"]
    """Which of `textures` each face shows."""
    textures: tuple[UInt8[Tensor, "_ _ 3"], ...]
    """Images, red, green, blue as displayed; one white pixel for faces without texture."""

    @classmethod
    def build(
        cls,
        vertices: Float[Tensor, "points 3"],
        faces: Int[Tensor, "faces 3"],
        *,
        colors: Float[Tensor, "faces 3 3"] | None = None,
        coordinates: Float[Tensor, "faces 3 2"] | None = None,
        textures: Sequence[UInt8[Tensor, "_ _ 3"]] = (),
        materials: Int[Tensor, " faces"] | None = None,
    ) -> "TexturedMesh":
        """Return the mesh with vertices in one place made one, unused ones left out, and its normals computed.

        Without colors and textures the mesh is plain gray; texture coordinates without materials belong to the first
        texture. Raises CaptureError for coordinates that are not numbers, for faces that name vertices which are not
        there, and for a mesh without a face that has an area.
        """
        if not len(faces):
            message = f"expected a mesh with triangles to render, got {len(vertices)} points without any"
            raise CaptureError(message, name="faces", value=0)
        check_finite_vertices(vertices.numpy())
        check_corners(faces.numpy(), len(vertices))
        check_area(vertices.double()[faces].numpy())
        used, rows = np.unique(vertices.numpy()[faces.numpy().ravel()], axis=0, return_inverse=True)
        welded = rows.reshape(-1, 3)
        textured = bool(textures)
        if colors is None:
            colors = torch.full((len(faces), 3, 3), 1.0 if textured else GRAY)
        return cls(
            vertices=torch.from_numpy(used).float(),
            faces=torch.from_numpy(welded),
            normals=torch.from_numpy(corner_normals(used, welded)).float(),
            colors=colors.float(),
            coordinates=torch.zeros(len(faces), 3, 2) if coordinates is None else coordinates.float(),
            materials=torch.zeros(len(faces), dtype=torch.int64) if materials is None else materials,
            textures=tuple(textures) or (torch.full((1, 1, 3), 255, dtype=torch.uint8),),
        )

    @classmethod
    def plain(cls, surface: Surface) -> "TexturedMesh":
        """Return a surface's triangles in gray; raises CaptureError as `build`, also for points without triangles."""
        return cls.build(surface.vertices, surface.faces)

    @cached_property
    def surface(self) -> Surface:
        """The shape alone."""
        return Surface(self.vertices, self.faces)

    @cached_property
    def corner_colors(self) -> Float[Tensor, "faces 3 3"]:
        """Each corner's color times that of the texel there, on the face's side of where two texels meet; 0 to 1."""
        inside = torch.lerp(self.coordinates.double(), self.coordinates.double().mean(1, keepdim=True), 1e-4)
        colors = self.colors.clone()
        for number, texture in enumerate(self.textures):
            chosen, size = self.materials == number, torch.tensor(texture.shape[1::-1])
            # Images count rows downwards, v counts up.
            column, row = torch.floor(inside[chosen] * size).long().remainder(size).unbind(2)
            colors[chosen] *= texture[-1 - row, column].float() / 255.0
        return colors


def read_textured_mesh(path: str | Path, *, meters: float = 1.0) -> TexturedMesh:
    """Read a mesh whose coordinates count `meters` each, with its textures, vertex colors or face colors.

    Parts of a scene become one mesh. Colors are taken as they are written and opaque, whatever the file says of
    light and transparency. Normals in the file are not used. What has no color at all, or whose texture file is
    missing or corrupt, is gray, and a `CaptureWarning` says so. Raises CaptureError as `load_mesh`, and where the
    file holds no triangles.
    """
    path = Path(path)
    parts = [part for part in load_parts(path) if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        wanted = "a mesh with triangles to render"
        advice = "export the mesh with its faces, or give the points as the capture's surface"
        raise CaptureError.expected(wanted, 0, got="none", file=path, name="faces", advice=advice)
    images = _images_of_obj(path)
    colors, coordinates, textures, remarks = zip(*(_paint(part, images) for part in parts), strict=True)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts]) * meters
    faces = np.concatenate([np.asarray(part.faces, dtype=np.int64) + start for part, start in zip(parts, offsets)])  # noqa: B905
    try:
        mesh = TexturedMesh.build(
            torch.from_numpy(vertices),
            torch.from_numpy(faces),
            colors=torch.from_numpy(np.concatenate(colors)),
            coordinates=torch.from_numpy(np.concatenate(coordinates)),
            textures=[torch.from_numpy(texture) for texture in textures],
            materials=torch.from_numpy(np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])),
        )
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}", **error.attributes | {"file": path}) from error
    for remark in dict.fromkeys(filter(None, remarks)):
        warnings.warn(remark.about(path), stacklevel=2)
    return mesh


def corner_normals(vertices: Float[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]) -> np.ndarray:
    """Return the unit normal at each corner, [faces, 3, 3]: the faces' mean around it, weighted by their angles there.

    Where a face leans more than `CREASE` from that mean, its corner keeps the face's own normal.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    flat, smooth = mesh.face_normals[:, None], mesh.vertex_normals[faces]
    sharp = (smooth * flat).sum(axis=-1, keepdims=True) < math.cos(math.radians(CREASE))
    return np.where(sharp, flat, smooth)


_PLACEHOLDER = trimesh.visual.material.empty_material().image.tobytes()
"""What trimesh puts in place of a material that it does not find, 2 x 2 dark pixels."""
_COLORLESS = CaptureWarning("has neither texture nor colors; it is rendered gray", name="colors")


def _paint(
    part: trimesh.Trimesh, images: dict[str, str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, CaptureWarning | None]:
    """Return the colors and the places in its texture of a part's corners, the texture, and what is to be said."""
    visual: Any = part.visual
    faces, remark = np.asarray(part.faces), None
    coordinates, texture = np.zeros((len(faces), 3, 2)), np.full((1, 1, 3), 255, dtype=np.uint8)
    material: Any = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and image.size == (2, 2) and image.tobytes() == _PLACEHOLDER:
        image = None
    factor, name = getattr(material, "baseColorFactor", None), str(getattr(material, "name", ""))
    colors = np.full(3, GRAY)
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[faces][..., :3] / 255.0
    elif visual.kind == "face":
        colors = np.asarray(visual.face_colors)[:, None, :3] / 255.0
    elif visual.kind == "texture" and image is not None and visual.uv is not None:
        try:
            texture = np.array(image.convert("RGB"))
        except (OSError, SyntaxError, ValueError) as error:  # what Pillow raises for images that are cut or corrupt
            remark = CaptureWarning(f"its texture cannot be read ({error}); it is rendered gray", name="texture")
        else:
            coordinates = np.nan_to_num(np.asarray(visual.uv, dtype=np.float64)[faces])
            colors = np.asarray([255.0] * 3 if factor is None else factor, dtype=np.float64)[:3] / 255.0
    elif visual.kind == "texture" and name in images:
        message = f"its texture {images[name]} is missing or cannot be placed; the part is rendered gray"
        remark = CaptureWarning(message, name="texture", value=images[name])
    elif visual.kind == "texture" and (factor is not None or "kd" in getattr(material, "kwargs", {})):
        colors = np.asarray(material.main_color, dtype=np.float64)[:3] / 255.0
    else:
        remark = _COLORLESS
    if visual.kind == "texture" and "color" in visual.vertex_attributes:
        # A glTF's colors at vertices multiply those of its material.
        own = trimesh.visual.color.to_rgba(np.array(visual.vertex_attributes["color"]))[faces][..., :3] / 255.0
        colors, remark = own * (1.0 if remark else colors), None if remark is _COLORLESS else remark
    return np.broadcast_to(colors, (len(faces), 3, 3)), coordinates, texture, remark


def _images_of_obj(path: Path) -> dict[str, str]:
    """Return, for each material of an obj file that names an image, the image's path from the file's folder."""
    return {
        name: os.path.relpath(image, path.parent)
        for library in libraries_of(path)
        for name, image in images_of_library(library).items()
    }


def libraries_of(path: Path) -> list[Path]:
    """Return the mtl files that an obj file names and that are there; none of other files."""
    if path.suffix.lower() != ".obj":
        return []
    text = path.read_text(encoding="utf-8", errors="replace")
    named = (path.parent / each for each in re.findall(r"^\s*mtllib\s+(.+?)\s*$", text, flags=re.MULTILINE))
    return [library for library in named if library.is_file()]


def images_of_library(path: Path) -> dict[str, Path]:
    """Return, for each material of an mtl file that names an image, where the image should be."""
    named, material = dict[str, Path](), ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        key, _, rest = line.strip().partition(" ")
        if key == "newmtl":
            material = rest.strip()
        elif key.lower() == "map_kd" and rest.strip():
            # The name may hold blanks, or come after options.
            whole = path.parent / rest.strip()
            named[material] = whole if whole.is_file() else path.parent / rest.split()[-1]
    return named
