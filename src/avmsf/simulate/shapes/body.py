"""What all shapes are made of: prisms laid side by side and end to end, cut into tetrahedra that fit together."""

import itertools
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int

from avmsf.fem.solid import Solid, prism_cells
from avmsf.mesh.points import unit

_MIN_MITRE_COSINE = 0.4
"""Least mean of the cosines between the normal at a corner and the faces around it that a mitre is made for."""


def mitred_normals(
    points: Float64[np.ndarray, "points 3"], triangles: Int[np.ndarray, "triangles 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Return a vector at each point that, added to all, moves the triangles around it by 1 along their normals.

    Its direction is the mean of their normals weighted by their angles at the point, which does not depend on how
    a plane is cut into triangles; it is longer than 1 where they form an edge or a corner.
    """
    corners = points[triangles]
    flat = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    sides = unit(np.roll(corners, -1, axis=1) - corners)
    angles = np.arccos(np.clip(-(sides * np.roll(sides, 1, axis=1)).sum(axis=-1), -1, 1))
    count = len(points)

    def gather(values: np.ndarray) -> np.ndarray:
        return np.bincount(triangles.ravel(), weights=values.ravel(), minlength=count)

    total = np.stack([gather(angles * flat[:, axis, None]) for axis in range(3)], axis=1)
    normals = unit(total)
    cosines = gather(angles * (normals[triangles] * flat[:, None]).sum(axis=-1)) / np.maximum(gather(angles), 1e-300)
    return normals / np.maximum(cosines, _MIN_MITRE_COSINE)[:, None]


class SolidBuilder:
    """A solid in the making, of prisms that `prism_cells` cuts into tetrahedra."""

    def __init__(self) -> None:
        self._points: list[np.ndarray] = []
        self._cells: list[np.ndarray] = []

    def lay(
        self,
        middle: Float64[np.ndarray, "points 3"],
        walls: Float64[np.ndarray, " points"] | float,
        triangles: Int[np.ndarray, "triangles 3"],
        order: Int[np.ndarray, " points"],
    ) -> tuple["Patch", "Patch"]:
        """Add a wall of one layer on both sides of triangles; return its lower and its upper side, all of them.

        `walls` is the thickness across the triangles, meters, which are counter-clockwise seen from the upper side.
        Numbers in `order` differ along every edge; they decide how the wall is cut into tetrahedra.
        """
        offsets = 0.5 * np.reshape(walls, (-1, 1)) * mitred_normals(middle, triangles)
        below, above = middle - offsets, middle + offsets
        lower = Patch(self, self.place(below), below, triangles, order)
        upper = Patch(self, self.place(above), above, triangles, order)
        lower.grow(above[None][:0], end=upper)
        return replace(lower, triangles=triangles[:, ::-1]), upper

    def place(self, places: Float64[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
        """Add points; return their rows."""
        first = sum(map(len, self._points))
        self._points.append(places)
        return np.arange(first, first + len(places))

    def fill(self, cells: Int[np.ndarray, "cells 4"]) -> None:
        """Add tetrahedra over points that are there, of positive volume."""
        self._cells.append(cells)

    @property
    def extent(self) -> float:
        """Longest side of the bounding box, meters."""
        return float(np.ptp(np.concatenate(self._points), axis=0).max())

    def solid(self, *, scale: float = 1.0) -> Solid:
        """Return all tetrahedra, `scale` times as large.

        Raises SimulationError where a wall is too thick for its bends, so that tetrahedra are turned inside out.
        """
        points, cells = np.concatenate(self._points) * scale, np.concatenate(self._cells)
        made = Solid(torch.from_numpy(points), torch.from_numpy(cells))
        # Before cells are turned to positive volume.
        made.expect_volume(advice="use thinner walls or a larger shape")
        return Solid.build(made.points, made.cells)


@dataclass(frozen=True, eq=False)
class Patch:
    """Some of the points on one side of a wall and the triangles among them, from which something grows."""

    body: SolidBuilder
    rows: Int[np.ndarray, " columns"]
    """Rows in the body."""
    places: Float64[np.ndarray, "columns 3"]
    """Meters."""
    triangles: Int[np.ndarray, "triangles 3"]
    """Columns, counter-clockwise seen from where it grows to."""
    order: Int[np.ndarray, " columns"]

    def part(self, columns: Int[np.ndarray, " some"]) -> "Patch":
        """Return the patch of some of the columns and of the triangles that are left among them."""
        place = np.full(len(self.order), -1)
        place[columns] = np.arange(len(columns))
        inside = place[self.triangles]
        inside = inside[(inside >= 0).all(axis=1)]
        return Patch(self.body, self.rows[columns], self.places[columns], inside, self.order[columns])

    def grow(self, layers: Float64[np.ndarray, "layers columns 3"], *, end: "Patch | None" = None) -> None:
        """Add prisms through layers of points, and to another patch, if any."""
        levels = [self.rows, *(self.body.place(layer) for layer in layers), *([] if end is None else [end.rows])]
        for below, above in itertools.pairwise(levels):
            cells = prism_cells(self.triangles, self.order, below, above)
            self.body.fill(cells.transpose(1, 0, 2).reshape(-1, 4))


def halves(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, rising: Bool[np.ndarray, " squares"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return both triangles of squares with these corners, cut from a to c where `rising`, else from b to d."""
    first = np.where(rising[:, None], np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    return first, np.where(rising[:, None], np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))


@dataclass(frozen=True, eq=False)
class Rings:
    """Points on rings from the inside out, the pole first if there is one, and triangles between them.

    Seen so that the angle grows counter-clockwise and rings outwards, so do the triangles. Diagonals alternate, so that
    turning by two points of the innermost ring, and mirroring at a point of it, changes nothing.
    """

    counts: tuple[int, ...]
    """Points on each ring, even numbers, from the inside out; each as many as the one before or twice as many."""
    pole: bool
    """Whether a point in the middle, which counts as ring 0, closes the innermost ring."""

    @cached_property
    def starts(self) -> Int[np.ndarray, " rings"]:
        """First row of each ring, and behind the last one."""
        return np.cumsum([0, *([1] if self.pole else []), *self.counts])

    @property
    def number(self) -> int:
        """Rings, with the pole."""
        return len(self.starts) - 1

    @cached_property
    def ring(self) -> Int[np.ndarray, " points"]:
        """Number of each point's ring."""
        return np.repeat(np.arange(self.number), np.diff(self.starts))

    @cached_property
    def turns(self) -> Float64[np.ndarray, " points"]:
        """Angle of each point, 0 to 1; 0 at the pole."""
        return (np.arange(self.starts[-1]) - self.starts[self.ring]) / np.diff(self.starts)[self.ring]

    @cached_property
    def order(self) -> Int[np.ndarray, " points"]:
        """Numbers that differ along every edge and mirror as the triangles do."""
        return 2 * self.ring + (np.arange(self.starts[-1]) - self.starts[self.ring]) % 2

    def rows(self, ring: int, places: Sequence[int] | np.ndarray) -> Int[np.ndarray, " places"]:
        """Return rows of points on a ring, counted around it from angle 0 in either direction."""
        return self.starts[ring] + np.asarray(places) % (self.starts[ring + 1] - self.starts[ring])

    @cached_property
    def triangles(self) -> Int[np.ndarray, "triangles 3"]:
        """Rows of points."""
        found = []
        for ring in range(self.number - 1):
            inner, outer = np.diff(self.starts[ring : ring + 3])
            # From the pole all triangles of a ring start in one point.
            k = np.arange(outer if inner == 1 else inner)
            a, after = self.rows(ring, k), self.rows(ring, k + 1)
            if outer == 2 * inner:
                b, between, beyond = (self.rows(ring + 1, 2 * k + step) for step in range(3))
                corners = ((a, b, between), (a, between, after), (after, between, beyond))
                found += [np.stack(each, axis=1) for each in corners]
                continue
            b, beyond = self.rows(ring + 1, k), self.rows(ring + 1, k + 1)
            found += (
                [np.stack([a, b, beyond], axis=1)] if inner == 1 else halves(a, b, beyond, after, (k + ring) % 2 == 0)
            )
        return np.concatenate(found)


@dataclass(frozen=True, eq=False)
class Draft:
    """A shape without its colors."""

    body: SolidBuilder
    wall: float
    """Nominal thickness, meters."""


Maker = Callable[[np.random.Generator, float | None], Draft]
"""Draws the proportions of one individual; walls as thick as given, meters, or drawn too."""


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of one thing."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def drawn_wall(random: np.random.Generator, low: float, high: float, wall: float | None) -> float:
    """Return the wall that was asked for, or one between two bounds, meters; draws in both cases."""
    drawn = random.uniform(low, high)
    return drawn if wall is None else wall
