"""Shapes cut from a sheet: plates with corners, trays, brackets and spoons."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int

from avmsf.simulate.shapes.body import Draft, Rings, SolidBuilder, drawn_wall, halves


@dataclass(frozen=True, eq=False)
class Grid:
    """Points row by row, with triangles counter-clockwise where columns count to the right and rows upwards.

    Diagonals meet in every second point, so that a grid with an odd number of rows and columns mirrors onto itself.
    """

    rows: int
    columns: int

    @cached_property
    def places(self) -> Int[np.ndarray, "points 2"]:
        """Row and column of each point."""
        return np.stack(np.divmod(np.arange(self.rows * self.columns), self.columns), axis=1)

    @cached_property
    def parts(self) -> Float64[np.ndarray, "points 2"]:
        """Place of each point along the columns and along the rows, -1 to 1."""
        row, column = self.places.T
        return np.stack([2.0 * column / (self.columns - 1) - 1.0, 2.0 * row / (self.rows - 1) - 1.0], axis=1)

    @cached_property
    def order(self) -> Int[np.ndarray, " points"]:
        """Numbers that differ along every edge and mirror as the triangles do."""
        row, column = self.places.T
        return np.where((row + column) % 2 == 1, 2, row % 2)

    @cached_property
    def triangles(self) -> Int[np.ndarray, "triangles 3"]:
        """Rows of points; two a square, square by square."""
        row, column = np.divmod(np.arange((self.rows - 1) * (self.columns - 1)), self.columns - 1)
        a = row * self.columns + column
        b, c, d = a + 1, a + 1 + self.columns, a + self.columns
        return np.stack(halves(a, b, c, d, (row + column) % 2 == 0), axis=1).reshape(-1, 3)


_POINTS = 900
_HOLE_HALF_SIDE = 2
"""Half the side of the block of squares that a hole takes the place of."""


def platter(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a flat rectangular plate."""
    length, width = random.uniform(0.16, 0.26), random.uniform(0.6, 0.8)
    wall = drawn_wall(random, 0.004, 0.008, wall)
    grid = _even_grid(length, width * length)
    places = grid.parts * (0.5 * length, 0.5 * width * length)
    middle = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
    return _draft(middle, wall, grid.triangles, grid.order)


def boomerang(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a flat boomerang, which tapers towards its ends."""
    radius, arc = random.uniform(0.09, 0.12), random.uniform(1.8, 2.3)
    width, taper = random.uniform(0.022, 0.03), random.uniform(0.4, 0.6)
    wall = drawn_wall(random, 0.004, 0.006, wall)
    grid = _even_grid(arc * radius, 2.0 * width)
    one, other = grid.parts.T
    out, angle = radius + width * other * (1.0 - taper * one**2), 0.5 * arc * one
    middle = np.stack([out * np.cos(angle), out * np.sin(angle), np.zeros(len(one))], axis=1)
    return _draft(middle, wall, grid.triangles, grid.order)


def channel(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a piece of a U profile."""
    length, width = random.uniform(0.16, 0.22), random.uniform(0.04, 0.05)
    side, bend = random.uniform(0.02, 0.03), random.uniform(0.008, 0.011)
    wall = drawn_wall(random, 0.0025, 0.0035, wall)
    across = width + math.pi * bend + 2.0 * side
    grid = _even_grid(length, across)
    one, other = grid.parts.T
    aside, up = _bent(0.5 * across * np.abs(other), 0.5 * width, 0.5 * math.pi, bend)
    middle = np.stack([0.5 * length * one, np.sign(other) * aside, up], axis=1)
    return _draft(middle, wall, grid.triangles, grid.order)


def scallop(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a fan-shaped shell with ribs."""
    radius, spread = random.uniform(0.09, 0.12), random.uniform(0.9, 1.1)
    depth, ribs = random.uniform(0.25, 0.35), int(random.integers(5, 8))
    rib = random.uniform(0.015, 0.025)
    wall = drawn_wall(random, 0.0025, 0.004, wall)
    grid = _even_grid(radius, 1.2 * radius)
    one, other = grid.parts.T
    part, angle = 0.2 + 0.4 * (1.0 + other), spread * one
    up = depth * (1.0 - part**2) * np.cos(0.5 * angle) + rib * part * np.cos(2.0 * ribs * angle)
    middle = radius * np.stack([part * np.cos(angle), part * np.sin(angle), up], axis=1)
    return _draft(middle, wall, grid.triangles, grid.order)


def tray(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a tray with bowed sides and a raised rim."""
    length, width = random.uniform(0.2, 0.28), random.uniform(0.55, 0.72)
    rise, bowed = random.uniform(0.018, 0.03), random.uniform(0.35, 0.6)
    wall = drawn_wall(random, 0.0025, 0.004, wall)
    grid = _even_grid(length, width * length)
    one, other = grid.parts.T
    inside = (1.0 - one**2) * (1.0 - other**2)
    middle = np.stack(
        [
            0.5 * length * one * np.sqrt(1.0 - 0.5 * bowed * other**2),
            0.5 * width * length * other * np.sqrt(1.0 - 0.5 * bowed * one**2),
            rise * np.clip(1.0 - inside / 0.45, 0.0, None) ** 2,
        ],
        axis=1,
    )
    return _draft(middle, wall, grid.triangles, grid.order)


def bracket(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a bent bracket with one slanting edge and two holes off its middle: no symmetry."""
    lengths = (random.uniform(0.08, 0.11), random.uniform(0.06, 0.075))
    width, slant = random.uniform(0.05, 0.06), random.uniform(0.25, 0.4)
    angle, bend = math.radians(random.uniform(60.0, 100.0)), random.uniform(0.01, 0.014)
    wall = drawn_wall(random, 0.0025, 0.004, wall)
    total = lengths[0] + angle * bend + lengths[1]
    grid = Grid(65, 13)
    one, other = grid.parts.T
    along = 0.5 * total * (1.0 + other)
    left, right = -0.5 * width, width * (0.5 - slant * along / total)
    flat = np.stack([along, left + 0.5 * (1.0 + one) * (right - left)], axis=1)
    kept = np.ones(len(grid.triangles), dtype=bool)
    for row, column in ((int(random.integers(9, 15)), 4), (int(random.integers(50, 55)), 7)):
        kept &= _punch(grid, flat, row, column)
    x, z = _bent(flat[:, 0], lengths[0], angle, bend)
    middle = np.stack([x, flat[:, 1], z], axis=1)
    return _draft(middle, wall, grid.triangles[kept], grid.order)


def spoon(random: np.random.Generator, wall: float | None) -> Draft:
    """Make a spoon."""
    length, width = random.uniform(0.027, 0.034), random.uniform(0.62, 0.72)
    depth, egg = random.uniform(0.22, 0.3), random.uniform(0.08, 0.16)
    handle, slope = random.uniform(0.12, 0.16), random.uniform(-0.15, 0.1)
    neck, end = random.uniform(0.0032, 0.004), random.uniform(0.0075, 0.01)
    wall = drawn_wall(random, 0.0018, 0.0026, wall)
    rings = Rings((12, 12, 24, 24, 24, 48, 48, 48, 48, 48), pole=True)
    angles, part = 2.0 * np.pi * rings.turns, rings.ring / (rings.number - 1)
    disc = np.stack(
        [
            length * part * np.cos(angles),
            width * length * part * np.sin(angles) * (1.0 - egg * part * np.cos(angles)),
            depth * length * (part**2 - 1.0),
        ],
        axis=1,
    )
    half, rows = 3, 58
    rim = rings.rows(rings.number - 1, np.arange(-half, half + 1))
    start = disc[rim]
    part_along = np.linspace(0.0, 1.0, rows + 1)[1:, None]
    fade = np.clip(1.0 - part_along / 0.22, 0.0, 1.0) ** 2
    widths = neck + (end - neck) * part_along**1.5
    widths = widths * np.sqrt(1.0 - 0.85 * np.clip((part_along - 0.94) / 0.06, 0.0, 1.0) ** 2)
    across = np.linspace(-1.0, 1.0, 2 * half + 1)
    steep = 2.0 * depth * (handle / length) * length
    rise = (
        steep * part_along * (1.0 - part_along) ** 5
        + 0.08 * handle * part_along**2 * (3.0 - 2.0 * part_along)
        + slope * handle * part_along**2 * (part_along - 1.0)
    )
    strip = np.stack(
        [
            start[:, 0] + part_along * (length + handle - start[:, 0]),
            fade * start[:, 1] + (1.0 - fade) * widths * across,
            np.broadcast_to(rise, (rows, len(across))),
        ],
        axis=-1,
    ).reshape(-1, 3)
    triangles, order = _attach(rings, rim, rows)
    swelling = np.repeat(1.0 + 0.9 * np.sin(math.pi * part_along[:, 0]) ** 0.5, len(across))
    swelling = np.concatenate([np.ones(len(disc)), swelling])
    return _draft(np.concatenate([disc, strip]), wall, triangles, order, swelling=swelling)


def _even_grid(length: float, width: float) -> Grid:
    """Return a grid of nearly square squares, of odd numbers of points."""
    columns = 2 * round(0.5 * math.sqrt(_POINTS * length / width)) + 1
    return Grid(2 * round(0.5 * _POINTS / columns) + 1, columns)


def _draft(
    middle: np.ndarray, wall: float, triangles: np.ndarray, order: np.ndarray, *, swelling: np.ndarray | float = 1.0
) -> Draft:
    """Return the shape of one sheet, `swelling` times as thick as the wall at each point."""
    body = SolidBuilder()
    body.lay(middle, wall * swelling, triangles, order)
    return Draft(body, wall)


def _punch(grid: Grid, flat: np.ndarray, row: int, column: int) -> np.ndarray:
    """Round the points around a block of squares to a circle, in place; return which triangles stay."""
    apart = grid.places - (row, column)
    ring = np.abs(apart).max(axis=1) == _HOLE_HALF_SIDE
    center = flat[row * grid.columns + column].copy()
    radius = 0.9 * np.abs(flat[ring] - center).max(axis=0).min()
    outward = apart[ring] / np.linalg.norm(apart[ring], axis=1, keepdims=True)
    flat[ring] = center + radius * outward
    return ~(np.abs(apart[grid.triangles]).max(axis=(1, 2)) <= _HOLE_HALF_SIDE)


def _bent(along: np.ndarray, first: float, angle: float, bend: float) -> tuple[np.ndarray, np.ndarray]:
    """Return x and z of places along a line that goes straight, round a bend upwards, and straight again."""
    turned = np.clip((along - first) / bend, 0.0, angle)
    before, after = np.minimum(along, first), np.maximum(along - first - angle * bend, 0.0)
    x = before + bend * np.sin(turned) + after * math.cos(angle)
    z = bend * (1.0 - np.cos(turned)) + after * math.sin(angle)
    return x, z


def _attach(rings: Rings, rim: np.ndarray, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles and order of rings and of a strip of `rows` that goes on from points of the last ring."""
    count, columns, last = int(rings.starts[-1]), len(rim), rings.number - 1
    lines = np.concatenate([rim, np.arange(count, count + rows * columns)]).reshape(-1, columns)
    # As rings do, from the same corner on, so that a plane through both mirrors the one as the other.
    row, column = np.divmod(np.arange(rows * (columns - 1)), columns - 1)
    a, after, b, beyond = (lines[row + up, column + right] for up, right in ((0, 0), (0, 1), (1, 0), (1, 1)))
    places = column - columns // 2
    strip = np.stack(halves(a, b, beyond, after, (places + row + last) % 2 == 0), axis=1).reshape(-1, 3)
    ring = np.repeat(np.arange(last + 1, last + 1 + rows), columns)
    parity = np.tile((np.arange(columns) - columns // 2) % 2, rows)
    order = np.concatenate([rings.order, 2 * ring + parity])
    return np.concatenate([rings.triangles, strip]), order
