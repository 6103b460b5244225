"""A small painted thing, photographed from all sides, and the plate's blows on it."""

import torch

from avmsf.mesh import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.photographs.cameras import View
from avmsf.photographs.mesh_views import orbit_cameras, render_views
from factories.plate_capture import PLATE
from factories.verbs import sets

THICKNESS = 0.02
"""Of the slab, meters; its upper side is the plate that is struck, at z = 0."""
SMALL_SPLAT = sets("splat.steps=60 splat.start_points=1500")


def slab() -> Surface:
    """Return a box below the plate's rectangle."""
    a, b = PLATE.length, PLATE.width
    corners = [(x, y, z) for z in (-THICKNESS, 0.0) for y in (0.0, b) for x in (0.0, a)]
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = [face for q in quads for face in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))]
    return Surface(torch.tensor(corners), torch.tensor(faces))


def slab_views(size: int = 48) -> tuple[View, ...]:
    """Return 24 pictures of the slab before black; its color changes from corner to corner."""
    surface, paint = slab(), torch.rand(8, 3, generator=torch.Generator().manual_seed(1))
    mesh = TexturedMesh.build(surface.vertices, surface.faces, colors=paint[surface.faces])
    cameras = orbit_cameras(mesh.surface, size=size, azimuths=8)
    return render_views(mesh, cameras, background=(0.0, 0.0, 0.0), supersample=2)
