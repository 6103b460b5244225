"""All kinds of shapes by name."""

import zlib
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float64, Int

from avmsf.errors import SimulationError
from avmsf.fem.solid import Solid
from avmsf.mesh.surface import Surface
from avmsf.simulate.shapes.decor import glaze
from avmsf.simulate.shapes.freeform import blob, dish
from avmsf.simulate.shapes.handled import jug, mug, skillet
from avmsf.simulate.shapes.shape import Draft, Maker, Shape
from avmsf.simulate.shapes.strips import bracket, platter, spoon, tray
from avmsf.simulate.shapes.vessels import bell, bowl, fluted, goblet, plate, pot, tube

_MAKERS: tuple[Maker, ...] = (
    bell, blob, bowl, bracket, dish, fluted, goblet, jug, mug, plate, platter, pot, skillet, spoon, tray, tube,
)  # fmt: skip
KINDS: Mapping[str, Maker] = MappingProxyType({maker.__name__: maker for maker in _MAKERS})
"""What draws and builds an individual of each kind."""
_LARGEST = 100.0
"""Meters."""
_FEWEST_FACES = 6000
_ROUNDS = 4
"""Drafts until walls and size are both as asked for."""


def make_shape(kind: str, *, seed: int | None = 0, size: float | None = None, wall: float | None = None) -> Shape:
    """Return one individual of a kind in `KINDS`; another seed draws other proportions and colors, None the first.

    `size` is the longest side of its bounding box and `wall` the nominal thickness of its walls, meters; both are
    drawn where they are not given, and a size alone scales the walls with everything else. Raises SimulationError for
    an unknown kind, for a negative seed, for sizes that are not positive, and for walls so thick that they fold over
    themselves or leave nothing of the shape.
    """
    if kind not in KINDS:
        raise SimulationError.expected(f"one of {', '.join(sorted(KINDS))}", kind, name="kind")
    seed = 0 if seed is None else seed
    if seed < 0:
        raise SimulationError(f"seed: expected 0 or more, got {seed}", name="seed", value=seed)
    for name, value in (("size", size), ("wall", wall)):
        if value is not None and not 0.0 < value <= _LARGEST:
            raise SimulationError.expected(f"more than 0 and at most {_LARGEST:g} m", value, name=name)
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
    colors = glaze(points, _chance(kind, seed, "colours"))
    return Shape(
        name=f"{kind}-{seed}",
        surface=Surface(torch.from_numpy(points).float(), torch.from_numpy(faces)),
        colors=torch.from_numpy(colors).float(),
        thickness=draft.wall * scale,
        symmetry=draft.symmetry,
        solid=solid,
    )


def _sized(kind: str, seed: int, size: float | None, wall: float | None) -> tuple[Draft, float]:
    """Return a draft and the factor that brings it to its size and walls."""
    scale = 1.0
    draft = KINDS[kind](_chance(kind, seed, "form"), wall if size is None else None)
    if size is None:
        return draft, scale
    for _ in range(1 if wall is None else _ROUNDS):
        scale = size / draft.body.extent
        if wall is not None:
            # Walls are drawn to the scale of the draft, whose size they change a little.
            draft = KINDS[kind](_chance(kind, seed, "form"), wall / scale)
    return draft, size / draft.body.extent


def _chance(kind: str, seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of one thing about an individual."""
    return np.random.default_rng([seed, zlib.crc32(f"{kind} {name}".encode())])


def _skin(solid: Solid) -> tuple[Float64[np.ndarray, "points 3"], Int[np.ndarray, "faces 3"]]:
    """Return a solid's outer triangles, each cut in four, and again until they are fine enough for colors."""
    used, rows = np.unique(solid.boundary.numpy(), return_inverse=True)
    points, faces = solid.points.numpy()[used], rows.reshape(-1, 3)
    while len(faces) < _FEWEST_FACES:
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
        edges, which = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
        a, b, c = faces.T
        ab, bc, ca = (which.reshape(-1, 3) + len(points)).T
        points = np.concatenate([points, 0.5 * (points[edges // len(points)] + points[edges % len(points)])])
        cut = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        faces = np.concatenate([np.stack(each, axis=1) for each in cut])
    return points, faces
