"""The difference of what two closed surfaces enclose."""

import manifold3d
import numpy as np
import torch

from avmsf.errors import SceneError
from avmsf.mesh.surface import Surface


def difference(surface: Surface, cut: Surface) -> Surface:
    """Return the largest connected part of what `surface` encloses and `cut` does not, as a closed surface.

    It has no triangles where nothing is left. Raises SceneError for surfaces that are not closed.
    """
    left = _manifold(surface) - _manifold(cut)
    if left.status() != manifold3d.Error.NoError:
        raise SceneError(
            f"expected two closed surfaces, got {left.status().name}; make the shape on finer cells",
            name="surface",
            value=left.status().name,
        )
    mesh = max(left.decompose(), key=lambda part: float(part.volume()), default=left).to_mesh()
    vertices, faces = np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts)
    return Surface(torch.from_numpy(vertices).float(), torch.from_numpy(faces).long())


def _manifold(surface: Surface) -> manifold3d.Manifold:
    vertices, faces = surface.vertices.numpy().astype(np.float32), surface.faces.numpy().astype(np.uint32)
    return manifold3d.Manifold(manifold3d.Mesh(vert_properties=vertices, tri_verts=faces))
