"""From points that know which way is out to a closed surface: Poisson reconstruction on a grid.

The function that is one inside the body and zero outside has a slope only at the skin, along the inward normals. So the
points' normals, each weighted by the piece of skin that it stands for and blurred over a cell, give the function up to
a constant by one division in the frequency domain (Kazhdan et al. 2006, "Poisson surface reconstruction"; Peng et al.
2021, "Shape as points"). The skin is where the function has the value that it has at most points. It is closed
whatever the points are: where they leave a hole the surface bridges it.
"""

import importlib
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import scipy.fft
import torch
from jaxtyping import Float, Float32, Float64, Int
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.capture.surface import Surface
from avmsf.errors import CaptureError

_FEWEST = 100
"""Points; what encloses a body is not known from fewer."""
_MARGIN = 0.15
"""Free room on each side of the points, in parts of their box's longest side: the grid repeats itself at its edge."""
_NEIGHBOURS = 8
"""Neighbours that tell how wide a piece of skin a point stands for."""
_SPECK = 0.02
"""Area of a part over the largest part's, below which it is no part of the body."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """A box of cubic cells that repeats itself."""

    lowest: Float64[np.ndarray, " 3"]
    """Middle of the first cell, metres."""
    spacing: float
    """Edge of a cell, metres."""
    shape: tuple[int, int, int]

    def places(self, points: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points 3"]:
        """Return where points are, counted in cells."""
        return (points - self.lowest) / self.spacing


def reconstruct_surface(
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    *,
    cells: int = 192,
    blur: float = 1.0,
    faces: int | None = None,
) -> Surface:
    """Return the closed surface of the body on whose skin the points lie, metres.

    `normals` point outwards and may have any length but zero. `cells` count along the longest side of the points' box;
    walls of three cells are kept. `blur` is the standard deviation, cells, by which the normals are blurred: more for
    points that are noisy, or farther apart than a cell. `faces` is as in `enclose`. Noise as large as a wall is thick
    leaves no wall.

    Raises CaptureError for fewer than 100 points, numbers that are not finite, normals without length or that point
    inwards, points in a plane, and where scikit-image or fast-simplification is missing.
    """
    places, directions = _checked(points, normals)
    if cells < 16 or not blur > 0 or (faces is not None and faces < 4):
        raise CaptureError(
            f"cells = {cells}, blur = {blur}, faces = {faces}: expected 16 cells, a blur above 0 and 4 triangles, "
            "or more"
        )
    grid = _grid(places, cells)
    inside = _inside(grid, places, directions * _areas(places)[:, None], blur)
    levels = map_coordinates(inside, grid.places(places).T, order=1)
    level = float(np.median(levels))
    if level <= 0:
        raise CaptureError(
            f"the normals of {len(places)} points enclose a body turned inside out: they point inwards, turn them round"
        )
    return enclose(inside, level, lowest=grid.lowest, spacing=grid.spacing, faces=faces)


def enclose(
    values: Float32[np.ndarray, "x y z"],
    level: float,
    *,
    lowest: Float64[np.ndarray, " 3"],
    spacing: float,
    faces: int | None = None,
) -> Surface:
    """Return the closed surface around all that is above `level` on a grid, triangles counter-clockwise from outside.

    `lowest` is the place of the first value and `spacing` the distance between two, metres; the values at the grid's
    edge must be below the level. Parts much smaller than the largest are left out. With `faces` the surface is made
    coarser until it has at most so many triangles, twice or four times as many where fewer would pinch it open. Raises
    CaptureError where nothing or everything is above the level, and where scikit-image or fast-simplification is
    missing.
    """
    if not float(values.max()) > level or any(
        float(values.take(end, axis=axis).max()) >= level for axis in range(3) for end in (0, -1)
    ):
        raise CaptureError(
            f"values from {values.min():g} to {values.max():g} enclose nothing at the level {level:g}: expected some "
            "above it, and none at the edge of the grid"
        )
    measure = _package("skimage.measure", "scikit-image")
    vertices, triangles, _, _ = measure.marching_cubes(values, level, gradient_direction="ascent")
    vertices, triangles = _without_specks(vertices.astype(np.float64), triangles.astype(np.int64))
    if faces is not None and len(triangles) > faces:
        vertices, triangles = _coarser(vertices, triangles, faces)
    return Surface(torch.from_numpy(lowest + spacing * vertices).float(), torch.from_numpy(triangles))


def _checked(
    points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"]
) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, "points 3"]]:
    """Return points and unit normals. Raises CaptureError, which names the first that cannot be used."""
    if len(points) < _FEWEST:
        raise CaptureError(
            f"expected {_FEWEST} points on the skin of a body or more, found {len(points)}: sample it more densely"
        )
    places, directions = (each.detach().cpu().double().numpy() for each in (points, normals))
    for name, values in (("point", places), ("normal", directions)):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(wrong):
            raise CaptureError(
                f"{name} {wrong[0]} (counted from 0) is {values[wrong[0]].tolist()}, and {len(wrong) - 1} others are "
                "not finite either: leave these points out"
            )
    lengths = np.linalg.norm(directions, axis=1)
    wrong = np.flatnonzero(lengths == 0)
    if len(wrong):
        raise CaptureError(
            f"normal {wrong[0]} (counted from 0) has no length, nor have {len(wrong) - 1} others: leave these points "
            "out, or give each the direction that points out of the body"
        )
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    if not spread[2] > 1e-6 * spread[0]:
        raise CaptureError(
            f"the {len(places)} points lie in one place, on a line or in a plane, their box is "
            f"{np.ptp(places, axis=0).tolist()} m wide: expected points all over the skin of a body"
        )
    return places, directions / lengths[:, None]


def _grid(places: Float64[np.ndarray, "points 3"], cells: int) -> _Grid:
    lowest, extent = places.min(axis=0), np.ptp(places, axis=0)
    spacing, margin = float(extent.max()) / cells, _MARGIN * float(extent.max())
    counts = [scipy.fft.next_fast_len(int(np.ceil((side + 2 * margin) / spacing)), real=True) for side in extent]
    room = np.array(counts) * spacing
    return _Grid(lowest - 0.5 * (room - extent), spacing, (counts[0], counts[1], counts[2]))


def _areas(places: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, " points"]:
    """Return the area of skin that each point stands for, square metres: less where points are dense."""
    reach = cKDTree(places).query(places, k=[_NEIGHBOURS + 1])[0][:, 0]
    # What lies alone is no wide piece of skin but a mistake.
    return np.pi * np.minimum(reach, 10 * np.median(reach)) ** 2 / _NEIGHBOURS


def _inside(
    grid: _Grid,
    places: Float64[np.ndarray, "points 3"],
    normals: Float64[np.ndarray, "points 3"],
    blur: float,
) -> Float32[np.ndarray, "x y z"]:
    """Return the function that is about one inside the body and zero at the grid's edge."""
    waves = [2 * np.pi * scipy.fft.fftfreq(count) for count in grid.shape[:2]]
    waves.append(2 * np.pi * scipy.fft.rfftfreq(grid.shape[2]))
    along = [wave.reshape([-1 if axis == each else 1 for each in range(3)]) for axis, wave in enumerate(waves)]
    square = sum(wave**2 for wave in along)
    square[0, 0, 0] = 1.0
    spread = _spread(grid.places(places), grid.shape)
    total = np.zeros(square.shape, dtype=np.complex64)
    for axis in range(3):
        field = (spread @ normals[:, axis]).reshape(grid.shape).astype(np.float32)
        total += along[axis].astype(np.float32) * scipy.fft.rfftn(field)
    # Spreading over the corners of a cell blurred by a third of a square cell already.
    total *= (1j * np.exp(-0.5 * max(blur**2 - 1 / 3, 0.0) * square) / square).astype(np.complex64)
    total[0, 0, 0] = 0.0
    inside = scipy.fft.irfftn(total, s=grid.shape) / np.float32(grid.spacing**2)
    edge = np.median([np.median(inside.take(0, axis=axis)) for axis in range(3)])
    return inside - np.float32(edge)


def _spread(places: Float64[np.ndarray, "points 3"], shape: tuple[int, int, int]) -> csr_array:
    """Return the matrix [cells, points] that shares each point out among the eight cells around it."""
    base = np.floor(places).astype(np.int64)
    part = places - base
    rows, weights = [], []
    for corner in np.ndindex(2, 2, 2):
        rows.append(np.ravel_multi_index(tuple((base + corner).T), shape))
        weights.append(np.prod(np.where(corner, part, 1 - part), axis=1))
    columns = np.tile(np.arange(len(places)), 8)
    size = (int(np.prod(shape)), len(places))
    return coo_array((np.concatenate(weights), (np.concatenate(rows), columns)), shape=size).tocsr()


def _without_specks(
    vertices: Float64[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "faces 3"]
) -> tuple[Float64[np.ndarray, "kept 3"], Int[np.ndarray, "remaining 3"]]:
    ends = triangles[:, [0, 1]], triangles[:, [1, 2]]
    rows, columns = np.concatenate(ends).T
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(vertices), len(vertices)))
    part = connected_components(links, directed=False)[1][triangles[:, 0]]
    corners = vertices[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    size = np.bincount(part, weights=areas)
    return _compact(vertices, triangles[size[part] >= _SPECK * size.max()])


def _compact(
    vertices: Float64[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "faces 3"]
) -> tuple[Float64[np.ndarray, "kept 3"], Int[np.ndarray, "remaining 3"]]:
    used, rows = np.unique(triangles, return_inverse=True)
    return vertices[used], rows.reshape(-1, 3)


def _coarser(
    vertices: Float64[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "faces 3"], faces: int
) -> tuple[Float64[np.ndarray, "fewer 3"], Int[np.ndarray, "coarse 3"]]:
    simplify = _package("fast_simplification", "fast-simplification").simplify
    wanted = faces
    while wanted < len(triangles):
        places, rows = simplify(vertices, triangles, target_count=wanted)
        fewer, coarse = _compact(places.astype(np.float64), rows.astype(np.int64))
        if _closed(coarse):
            return fewer, coarse
        # Where it pinches a thin part off, a finer one does not.
        wanted *= 2
    return vertices, triangles


def _closed(triangles: Int[np.ndarray, "faces 3"]) -> bool:
    """Return whether each edge is run along once in each direction."""
    edges = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    once = np.unique(edges, axis=0)
    return len(once) == len(edges) and bool(np.array_equal(once, np.unique(edges[:, ::-1], axis=0)))


def _package(module: str, package: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise CaptureError(
            f"surfaces from points and Gaussians need {package}, which cannot be imported ({error}): "
            "pip install 'avmsf[fem]'"
        ) from error
