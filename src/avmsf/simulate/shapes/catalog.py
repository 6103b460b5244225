"""All kinds of shapes by name: individuals of a size and a wall, with their surface, tetrahedra and colors."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.remeshing import halved
from avmsf.fem.solid import Solid
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import TexturedMesh
from avmsf.simulate.shapes.body import Draft, Maker, stream
from avmsf.simulate.shapes.freeform import blob
from avmsf.simulate.shapes.revolution import bell, bottle, bowl, dish, fluted, goblet, lid, plate, pot, tube
from avmsf.simulate.shapes.sheet import boomerang, bracket, channel, platter, scallop, spoon, tray
from avmsf.simulate.shapes.sweep import jug, mug, skillet

_MAKERS: tuple[Maker, ...] = (
    bell, blob, boomerang, bottle, bowl, bracket, channel, dish, fluted, goblet, jug, lid, mug, plate, platter, pot,
    scallop, skillet, spoon, tray, tube,
)  # fmt: skip
KINDS: Mapping[str, Maker] = MappingProxyType({maker.__name__: maker for maker in _MAKERS})
"""What draws and builds an individual of each kind."""
_MIN_FACES = 6000
_MAX_DRAFTS = 4
"""Drafts until walls and size are both as asked for."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One individual of a kind: upright along z, its axis, if any, the z axis."""

    surface: Surface
    """Closed triangles, counter-clockwise from outside, meters: the solid's surface, with its triangles subdivided."""
    colors: Float[Tensor, "points 3"]
    """Red, green, blue at each vertex of the surface as displayed (sRGB), 0 to 1."""
    thickness: float
    """Nominal thickness of the walls, meters; of a lump without walls its smallest extent."""
    solid: Solid
    """Tetrahedra, in the surface to rounding."""


def textured(shape: Shape) -> TexturedMesh:
    """Return a shape's surface in its colors, to render it with `avmsf.photographs.mesh_views.render_views`."""
    faces = shape.surface.faces
    return TexturedMesh.build(shape.surface.vertices, faces, colors=shape.colors[faces])


def make_shape(kind: str, *, seed: int = 0, size: float | None = None, wall: float | None = None) -> Shape:
    """Return one individual of a kind in `KINDS`; another seed draws other proportions and colors.

    `size` is the longest side of its bounding box and `wall` the nominal thickness of its walls, meters; both are
    drawn where they are not given, and a size alone scales the walls with everything else. Raises SimulationError for
    an unknown kind, and for walls so thick that they fold over themselves or leave nothing of the shape.
    """
    if kind not in KINDS:
        raise SimulationError.expected(f"one of {', '.join(sorted(KINDS))}", kind, name="kind")
    draft, scale = _sized(kind, seed, size, wall)
    try:
        solid = draft.body.solid(scale=scale)
    except SimulationError as error:
        thickness = scale * draft.wall
        raise SimulationError(
            f"{kind}, seed {seed}, wall of {1000.0 * thickness:g} mm: {error}", name="wall", value=thickness
        ) from error
    points, faces = _skin(solid)
    # The name is part of the seed: with another one, all objects have other colors.
    colors = glaze(points, stream(seed, f"{kind} colours"))
    return Shape(
        surface=Surface(torch.from_numpy(points).float(), torch.from_numpy(faces)),
        colors=torch.from_numpy(colors).float(),
        thickness=draft.wall * scale,
        solid=solid,
    )


def _sized(kind: str, seed: int, size: float | None, wall: float | None) -> tuple[Draft, float]:
    """Return a draft and the factor that brings it to its size and walls."""
    draft = KINDS[kind](stream(seed, f"{kind} form"), wall if size is None else None)
    if size is None or wall is None:
        return draft, 1.0 if size is None else size / draft.body.extent
    for _ in range(_MAX_DRAFTS):
        # Walls are drawn to the scale of the draft, whose size they change a little.
        draft = KINDS[kind](stream(seed, f"{kind} form"), wall / (size / draft.body.extent))
    return draft, size / draft.body.extent


def _skin(solid: Solid) -> tuple[Float64[np.ndarray, "points 3"], Int[np.ndarray, "faces 3"]]:
    """Return a solid's outer triangles, each cut in four, and again until they are fine enough for colors."""
    used, rows = np.unique(solid.boundary.numpy(), return_inverse=True)
    points, faces = solid.points.numpy()[used], rows.reshape(-1, 3)
    while len(faces) < _MIN_FACES:
        points, faces = halved(points, faces)
    return points, faces


_GLAZES = np.array([
    (0.93, 0.91, 0.85), (0.55, 0.68, 0.74), (0.72, 0.79, 0.68), (0.84, 0.62, 0.44),
    (0.45, 0.52, 0.60), (0.88, 0.78, 0.52), (0.62, 0.42, 0.36), (0.80, 0.76, 0.82),
])  # fmt: skip
_PAINTS = np.array([
    (0.13, 0.22, 0.48), (0.55, 0.13, 0.12), (0.10, 0.33, 0.28), (0.20, 0.14, 0.12),
    (0.86, 0.52, 0.10), (0.97, 0.95, 0.90), (0.38, 0.20, 0.45),
])  # fmt: skip
_EDGE_WIDTH = 0.006
"""Width of the edge of what is painted, in object diagonals."""
_MIN_CONTRAST = 0.45

Decor = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""From places in object diagonals, about the middle, to how far inside of the paint each lies, in diagonals."""


def glaze(points: Float64[np.ndarray, "points 3"], random: np.random.Generator) -> Float64[np.ndarray, "points 3"]:
    """Return red, green and blue of each point, 0 to 1: a glaze, uneven as fired ones are, with paint on it."""
    low, high = points.min(axis=0), points.max(axis=0)
    places = (points - 0.5 * (low + high)) / np.linalg.norm(high - low)
    ground = _GLAZES[random.integers(len(_GLAZES))]
    contrast = np.linalg.norm(_PAINTS - ground, axis=1)
    fitting = _PAINTS[contrast > _MIN_CONTRAST]
    paint = fitting[random.integers(len(fitting))]
    decor = DECORS[int(random.integers(len(DECORS)))]
    inside = np.clip(0.5 + decor(places, random) / _EDGE_WIDTH, 0.0, 1.0)[:, None]
    colors = ground + inside * (paint - ground)
    cloudy = 0.03 + 0.07 * random.random()
    light = 1.0 + cloudy * _waves(places, random, 0.35, 12) + 0.02 * random.standard_normal(len(points))
    return np.clip(colors * light[:, None], 0.0, 1.0)


def _bands(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Two to four level bands."""
    low, high = places[:, 2].min(), places[:, 2].max()
    number = int(random.integers(2, 5))
    levels = low + (high - low) * np.sort(random.uniform(0.1, 0.98, number))
    width = random.uniform(0.012, 0.03)
    return (width - np.abs(places[:, 2, None] - levels)).max(axis=1)


def _dipped(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """All beyond a slanting plane."""
    slanting = np.array([random.normal(), random.normal(), 1.0])
    heights = places @ (slanting / np.linalg.norm(slanting))
    return heights - np.quantile(heights, random.uniform(0.45, 0.75))


def _spots(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Round spots anywhere."""
    centers = places[random.integers(len(places), size=int(random.integers(14, 30)))]
    radii = random.uniform(0.025, 0.06, len(centers))
    return (radii - np.linalg.norm(places[:, None] - centers, axis=-1)).max(axis=1)


def _strokes(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Curved lines as of a brush."""
    height = _waves(places, random, random.uniform(0.35, 0.6), 6)
    # The field's slope is about 2 pi over its wavelength: so wide a stroke is a few hundredths of the diagonal.
    return 0.08 * (0.28 - np.abs(height))


def _patches(places: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Large patches with wavy outlines."""
    height = _waves(places, random, 0.5, 8)
    return 0.08 * (height - np.quantile(height, random.uniform(0.55, 0.75)))


DECORS: tuple[Decor, ...] = (_bands, _dipped, _spots, _strokes, _patches)


def _waves(places: np.ndarray, random: np.random.Generator, length: float, number: int) -> np.ndarray:
    """Return a smooth field of root mean square 1 in space, of waves about this long."""
    wave_vectors = random.standard_normal((number, 3))
    wave_vectors /= np.linalg.norm(wave_vectors, axis=1, keepdims=True) * length * random.uniform(0.7, 1.5, (number, 1))
    phases = random.uniform(0.0, 2.0 * math.pi, number)
    return math.sqrt(2.0 / number) * np.cos(2.0 * math.pi * places @ wave_vectors.T + phases).sum(axis=1)
