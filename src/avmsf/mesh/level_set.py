"""Closed surfaces by libraries: of what values on a grid enclose, thinned, and of the difference of two."""

from threading import Lock

import fast_simplification
import manifold3d
import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int

from avmsf.errors import CaptureError, SceneError
from avmsf.mesh.points import connected_parts
from avmsf.mesh.surface import Surface

_SPECK = 0.02
"""Area of a part over the largest part's, below which it does not belong to the object."""
_DECIMATING = Lock()


def enclose(
    values: Float32[np.ndarray, "x y z"],
    level: float,
    *,
    lowest: Float64[np.ndarray, " 3"],
    spacing: float,
    faces: int | None = None,
) -> Surface:
    """Return the closed surface around all that is above `level` on a grid, triangles counter-clockwise from outside.

    `lowest` is the position of the first value and `spacing` the distance between two, meters; the values at the grid's
    edge must be below the level. Parts much smaller than the largest are left out. With `faces` the surface is made
    coarser until it has at most so many triangles, twice or four times as many where fewer would pinch it open. Raises
    CaptureError where nothing or everything is above the level.
    """
    if not float(values.max()) > level or any(
        float(values.take(end, axis=axis).max()) >= level for axis in range(3) for end in (0, -1)
    ):
        least, most = float(values.min()), float(values.max())
        message = f"expected values above {level:g} inside the grid and none at its edge, got {least:g} to {most:g}"
        raise CaptureError(message, name="values", value=[least, most])
    # Imported here, for it takes a third of a second that hardly any command needs.
    from skimage import measure

    drawn = measure.marching_cubes(values, level, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    vertices, triangles = drawn[:2]
    vertices, triangles = _without_specks(vertices.astype(np.float64), triangles.astype(np.int64))
    while faces is not None and faces < len(triangles):
        fewer, coarse = _compact(*decimated(vertices, triangles, faces))
        if _closed(coarse):
            vertices, triangles = fewer, coarse
            break
        # Where it pinches a thin part off, a finer one does not.
        faces *= 2
    return Surface(torch.from_numpy(lowest + spacing * vertices).float(), torch.from_numpy(triangles))


def _without_specks(
    vertices: Float64[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "faces 3"]
) -> tuple[Float64[np.ndarray, "kept 3"], Int[np.ndarray, "remaining 3"]]:
    ends = np.concatenate([triangles[:, :2], triangles[:, 1:]])
    part = connected_parts(ends, len(vertices))[triangles[:, 0]]
    corners = vertices[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    size = np.bincount(part, weights=areas)
    return _compact(vertices, triangles[size[part] >= _SPECK * size.max()])


def _compact(
    vertices: Float64[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "faces 3"]
) -> tuple[Float64[np.ndarray, "kept 3"], Int[np.ndarray, "remaining 3"]]:
    used, rows = np.unique(triangles, return_inverse=True)
    return vertices[used], rows.reshape(-1, 3)


def decimated(
    vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "faces 3"], count: int
) -> tuple[Float64[np.ndarray, "fewer 3"], Int[np.ndarray, "coarse 3"]]:
    """Return about `count` triangles in place of more, by quadrics (Garland and Heckbert, SIGGRAPH 1997)."""
    # The library keeps the mesh in variables of the process between its calls: two threads would mix their meshes.
    with _DECIMATING:
        places, rows = fast_simplification.simplify(vertices, triangles, target_count=count)
    return places.astype(np.float64), rows.astype(np.int64)


def _closed(triangles: Int[np.ndarray, "faces 3"]) -> bool:
    """Return whether each edge is run along once in each direction."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    once = np.unique(edges, axis=0)
    return len(once) == len(edges) and bool(np.array_equal(once, np.unique(edges[:, ::-1], axis=0)))


def difference(surface: Surface, cut: Surface) -> Surface:
    """Return the largest connected part of what `surface` encloses and `cut` does not, as a closed surface.

    It has no triangles where nothing is left. Raises SceneError for surfaces that are not closed.
    """
    left = _manifold(surface) - _manifold(cut)
    if left.status() != manifold3d.Error.NoError:
        status = left.status().name
        message = f"expected two closed surfaces, got {status}; make the shape on finer cells"
        raise SceneError(message, name="surface", value=status)
    parts = left.decompose()
    largest = max(parts, key=lambda part: float(part.volume()), default=left)
    # The surface of a cavity without an opening is a part by itself, turned inwards.
    mesh = (largest ^ left if any(part.volume() < 0 for part in parts) else largest).to_mesh()
    vertices, faces = np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts)
    return Surface(torch.from_numpy(vertices).float(), torch.from_numpy(faces).long())


def _manifold(surface: Surface) -> manifold3d.Manifold:
    vertices, faces = surface.vertices.numpy().astype(np.float32), surface.faces.numpy().astype(np.uint32)
    return manifold3d.Manifold(manifold3d.Mesh(vert_properties=vertices, tri_verts=faces))
