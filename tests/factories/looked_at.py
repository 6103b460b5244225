"""Closed forms as meshes, with the views and the depth that cameras around them take."""

from collections.abc import Sequence

import numpy as np
import torch
import trimesh

from avmsf.gaussians.visibility import DepthMap
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.mesh_views import MeshTracer, orbit_cameras, render_views

RADIUS, HEIGHT = 0.05, 0.06
"""Of a cup, meters."""


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(torch.from_numpy(np.asarray(mesh.vertices)).float(), torch.from_numpy(np.asarray(mesh.faces)).long())


def sphere(radius: float = 0.05, subdivisions: int = 3) -> Surface:
    return surface_of(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def mesh_of(surface: Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices.numpy(), surface.faces.numpy(), process=False)


def views_of(
    mesh: trimesh.Trimesh, *, elevations: Sequence[float] = (0.0, 45.0, -45.0), azimuths: int = 12, size: int = 128
) -> tuple[View, ...]:
    surface = surface_of(mesh)
    cameras = orbit_cameras(surface, size=size, elevations=elevations, azimuths=azimuths)
    return render_views(TexturedMesh.plain(surface), cameras)


def depth_of(mesh: trimesh.Trimesh, *, behind: float = 0.0) -> DepthMap:
    """Return what gives the depth of a mesh, or of what lies `behind` it, meters."""
    tracer = MeshTracer(surface_of(mesh))

    def depth(camera: Camera) -> torch.Tensor:
        found = tracer.depth(camera)
        return torch.where(found > 0, found + behind, 0.0)

    return depth


def ball(radius: float = 0.05) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def cup(*, radius: float = RADIUS, height: float = HEIGHT, wall: float = 0.004) -> trimesh.Trimesh:
    """Return an open cup that stands on z = 0."""
    outline = [(0, 0), (radius, 0), (radius, height), (radius - wall, height), (radius - wall, wall), (0, wall)]
    return trimesh.creation.revolve(np.array(outline), sections=96)


def cup_volume(wall: float) -> float:
    return float(np.pi * (RADIUS**2 * HEIGHT - (RADIUS - wall) ** 2 * (HEIGHT - wall)))
