"""Grids of cells, and closed surfaces by libraries: of what values on them enclose, thinned, and differences of two."""

from dataclasses import dataclass
from threading import Lock

import fast_simplification
import manifold3d
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Real

from avmsf.errors import SceneError
from avmsf.mesh.points import connected_parts
from avmsf.mesh.surface import Surface

_SPECK = 0.02
"""Area of a part over the largest part's, below which it does not belong to the object."""
_DECIMATING = Lock()


@dataclass(frozen=True, eq=False)
class Grid:
    """Cells of equal edges; values belong to the middles of cells."""

    lowest: Float64[np.ndarray, " 3"]
    """Middle of the first cell, object frame, meters."""
    spacing: float
    """Edge of a cell, meters."""
    shape: tuple[int, int, int]
    """Cells along x, y and z."""

    @classmethod
    def around(
        cls, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], *, cells: int, finest: float, margin: int
    ) -> "Grid":
        """Return a grid of `cells` along the longest side of a box, and `margin` cells more on each side.

        A box that fills less than half of its cube has finer cells, at most `finest` times as fine, as many as half
        the cube would have: slender objects are thin.
        """
        extent = high - low
        filled = float(np.prod(extent / extent.max()))
        spacing = float(extent.max()) / cells * min(max((2.0 * filled) ** (1 / 3), 1 / finest), 1.0)
        counts = np.ceil(extent / spacing).astype(int) + 2 * margin + 1
        middle = (low + high) / 2
        return cls(middle - spacing * (counts - 1) / 2, spacing, (int(counts[0]), int(counts[1]), int(counts[2])))

    @classmethod
    def filling(cls, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], *, cells: int) -> "Grid":
        """Return a grid of about so many cells in all, which fill a box."""
        edge = float(np.prod(high - low) / cells) ** (1 / 3)
        x, y, z = np.maximum(1, np.ceil((high - low) / edge)).astype(int).tolist()
        return cls(low + edge / 2, edge, (x, y, z))

    def centers(self, rows: Real[np.ndarray, "*cells 3"]) -> Float64[np.ndarray, "*cells 3"]:
        """Return the middles of cells given by their indices, meters."""
        return self.lowest + self.spacing * rows

    def box(self, inside: Bool[np.ndarray, "x y z"]) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
        """Return the middles of the lowest and highest of the cells that are inside, of which there must be one."""
        rows = np.argwhere(inside)
        return self.centers(rows.min(axis=0)), self.centers(rows.max(axis=0))

    def coarser(self, factor: int) -> "Grid":
        """Return a grid that covers this one with cells `factor` times as wide; both have the same first middle."""
        counts = [-(-(count - 1) // factor) + 1 for count in self.shape]
        return Grid(self.lowest, self.spacing * factor, (counts[0], counts[1], counts[2]))


def touches_edge(solid: Bool[np.ndarray, "x y z"]) -> bool:
    """Whether anything is solid in the outermost cells of a grid."""
    return any(solid.take(end, axis=axis).any() for axis in range(3) for end in (0, -1))


def enclose(values: Float32[np.ndarray, "x y z"], grid: Grid, faces: int | None = None) -> Surface:
    """Return the closed surface around all that is above zero on a grid, triangles counter-clockwise from outside.

    Parts much smaller than the largest are left out. With `faces` the surface is made coarser until it has at most so
    many triangles, twice or four times as many where fewer would pinch it open. Raises SceneError where nothing is
    inside, and where the inside touches the grid's edge.
    """
    if not float(values.max()) > 0.0 or touches_edge(values >= 0.0):
        least, most = float(values.min()), float(values.max())
        wanted, got = "a shape with an inside: values above 0, and none at the grid's edge", f"{least:g} to {most:g}"
        raise SceneError.expected(wanted, [least, most], got=got, name="values")
    # Imported here, for it takes a third of a second that hardly any command needs.
    import trimesh
    from skimage import measure

    drawn = measure.marching_cubes(values, 0.0, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    vertices, triangles = drawn[:2]
    vertices, triangles = _without_specks(vertices.astype(np.float64), triangles.astype(np.int64))
    while faces is not None and faces < len(triangles):
        fewer, coarse = _compact(*decimated(vertices, triangles, faces))
        if all(trimesh.graph.is_watertight(trimesh.geometry.faces_to_edges(coarse))):  # type: ignore[no-untyped-call]
            vertices, triangles = fewer, coarse
            break
        # Where it pinches a thin part off, a finer one does not.
        faces *= 2
    return Surface(torch.from_numpy(grid.lowest + grid.spacing * vertices).float(), torch.from_numpy(triangles))


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
