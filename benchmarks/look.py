"""Objects with colors on them, and pictures: what the benchmarks of features and of the pipeline use."""

from collections.abc import Callable

import numpy as np
import torch
import trimesh
from jaxtyping import UInt8
from torch import Tensor

from avmsf.mesh import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.cameras import View
from avmsf.photographs.mesh_views import orbit_cameras, render_views
from tests.oracles.plate import Plate

AMBIENT = 0.3
"""One lamp in one place, which lights an object's symmetric parts differently."""


def slab(plate: Plate, *, thickness: float = 0.02) -> Surface:
    """Return a box whose upper side is the plate; it is thicker than the plate, so that its edges show in pictures."""
    box = trimesh.creation.box((plate.length, plate.width, thickness))
    box.apply_translation((plate.length / 2, plate.width / 2, -thickness / 2))
    return _surface(box)


def speckled(surface: Surface, *, seed: int) -> TexturedMesh:
    """Return a surface with blotches of color on it, laid on from above and from the sides as on a printed box."""
    generator = torch.Generator().manual_seed(seed)
    corners = surface.vertices[surface.faces]
    low, high = surface.vertices.amin(0), surface.vertices.amax(0)
    placed = (corners - low) / (high - low).max()
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = torch.tensor([[1, 2], [0, 2], [0, 1]])[normals.abs().argmax(1)]
    coordinates = placed.gather(2, across[:, None, :].expand(-1, 3, -1))
    return TexturedMesh.build(surface.vertices, surface.faces, coordinates=coordinates, textures=[_blotches(generator)])


def pictures(mesh: TexturedMesh, *, count: int, size: int) -> tuple[View, ...]:
    """Return pictures from three elevations before black."""
    cameras = orbit_cameras(mesh.surface, size=size, azimuths=count // 3)
    return render_views(mesh, cameras, ambient=AMBIENT, background=(0.0, 0.0, 0.0))


def _bowl() -> trimesh.Trimesh:
    angle = np.linspace(0.0, 0.45 * np.pi, 40)
    outer = np.c_[np.sin(angle), 1 - np.cos(angle)]
    inner = np.c_[0.94 * np.sin(angle), 1 - 0.94 * np.cos(angle)][::-1]
    return trimesh.creation.revolve(np.r_[outer, inner] * 0.08, sections=96)


SHAPES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "bowl": _bowl,
    "box": lambda: trimesh.creation.box((0.2, 0.13, 0.07)),
    "hexagonal prism": lambda: trimesh.creation.cylinder(0.06, 0.12, sections=6),
}
"""Shapes with a continuous axis, three mirror planes, and a six-fold axis; meters."""


def shape(name: str) -> Surface:
    """Return one of `SHAPES`, a surface."""
    return _surface(SHAPES[name]())


def _surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(torch.from_numpy(np.array(mesh.vertices)).float(), torch.from_numpy(np.array(mesh.faces)).long())


def _blotches(generator: torch.Generator) -> UInt8[Tensor, "256 256 3"]:
    """Return noise of two sizes, smooth and fine, in strong colors."""
    image = torch.zeros(1, 3, 256, 256)
    for cells, weight in ((6, 1.0), (32, 0.6)):
        noise = torch.rand(1, 3, cells, cells, generator=generator) - 0.5
        image += weight * torch.nn.functional.interpolate(noise, size=256, mode="bicubic", align_corners=False)
    return (255 * (0.5 + image[0]).clamp(0, 1)).to(torch.uint8).permute(1, 2, 0).contiguous()
