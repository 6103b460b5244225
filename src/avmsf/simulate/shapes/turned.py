"""Walls that turn about an axis, exactly or with lobes and corners, and what is fixed to them."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int
from scipy.interpolate import BSpline

from avmsf.simulate.shapes.body import Body, Sheet


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
            inner, outer = (int(self.starts[each + 1] - self.starts[each]) for each in (ring, ring + 1))
            if inner == 1:
                k = np.arange(outer)
                found.append(np.stack([np.zeros_like(k), self.rows(1, k), self.rows(1, k + 1)], axis=1))
            elif outer == inner:
                found.append(self._band(ring, np.arange(inner)))
            else:
                found.append(self._doubling(ring, np.arange(inner)))
        return np.concatenate(found)

    def _band(self, ring: int, k: np.ndarray) -> np.ndarray:
        a, after = self.rows(ring, k), self.rows(ring, k + 1)
        b, beyond = self.rows(ring + 1, k), self.rows(ring + 1, k + 1)
        rising = ((k + ring) % 2 == 0)[:, None]
        first = np.where(rising, np.stack([a, b, beyond], axis=1), np.stack([a, b, after], axis=1))
        second = np.where(rising, np.stack([a, beyond, after], axis=1), np.stack([b, beyond, after], axis=1))
        return np.concatenate([first, second])

    def _doubling(self, ring: int, k: np.ndarray) -> np.ndarray:
        a, after = self.rows(ring, k), self.rows(ring, k + 1)
        b, between, beyond = (self.rows(ring + 1, 2 * k + step) for step in range(3))
        corners = ((a, b, between), (a, between, after), (after, between, beyond))
        return np.concatenate([np.stack(each, axis=1) for each in corners])


@dataclass(frozen=True, eq=False)
class Patch:
    """Some of the points of a sheet and the triangles among them, from which something grows."""

    rows: Int[np.ndarray, " columns"]
    triangles: Int[np.ndarray, "triangles 3"]
    """Rows of `rows`."""
    order: Int[np.ndarray, " columns"]

    @classmethod
    def of(
        cls,
        triangles: Int[np.ndarray, "all 3"],
        order: Int[np.ndarray, " points"],
        rows: Int[np.ndarray, " columns"],
        *,
        lower: bool,
    ) -> "Patch":
        """Return the patch of these rows of a sheet's points, on its lower side or its upper one."""
        column = np.full(len(order), -1)
        column[rows] = np.arange(len(rows))
        inside = triangles[(column[triangles] >= 0).all(axis=1)]
        found = column[inside]
        return cls(rows, found[:, ::-1] if lower else found, order[rows])


POINTS = 900
"""Points in the middle of a wall: about 12 nodes of second order each, so some 32,000 degrees of freedom."""
_FINE = 2000
_LEAST, _MOST = 8, 34
"""Points of the innermost ring."""


@dataclass(frozen=True, eq=False)
class Profile:
    """The middle of a wall as a smooth curve from the axis, or the lower end of a tube, outwards to the rim."""

    controls: Sequence[tuple[float, float, float]]
    """Radius, height and thickness, meters; the curve starts at the first, ends at the last and rounds those between.
    At the axis the first two have one height, so that the curve crosses it level."""

    @classmethod
    def scaled(
        cls, radius: float, height: float, wall: float, corners: Sequence[tuple[float, float, float]]
    ) -> "Profile":
        """Return the profile whose corners are multiples of a radius, a height and a wall."""
        return cls([(out * radius, up * height, thick * wall) for out, up, thick in corners])

    @cached_property
    def _curve(self) -> tuple[Float64[np.ndarray, " fine"], Float64[np.ndarray, "fine 3"]]:
        """Places along the curve, 0 to 1 of its length, and radius, height and thickness there."""
        controls = np.array(self.controls, dtype=np.float64)
        inner = np.linspace(0.0, 1.0, len(controls) - 1)[1:-1]
        knots = np.concatenate([np.zeros(3), inner, np.ones(3)])
        values = BSpline(knots, controls, 2)(np.linspace(0.0, 1.0, _FINE))
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(values[:, :2], axis=0), axis=1))])
        return length / length[-1], values

    @cached_property
    def length(self) -> float:
        """Meters along the curve."""
        return float(np.linalg.norm(np.diff(self._curve[1][:, :2], axis=0), axis=1).sum())

    def at(self, along: Float64[np.ndarray, " places"]) -> Float64[np.ndarray, "places 3"]:
        """Return radius, height and thickness at parts of the curve's length, 0 to 1."""
        places, values = self._curve
        return np.stack([np.interp(along, places, values[:, axis]) for axis in range(3)], axis=1)

    def rings(self, *, fold: int = 1, points: int = POINTS) -> Rings:
        """Return about `points` points on rings evenly along the curve, with triangles as equilateral as they may be.

        Rings of less than half and a quarter of the largest radius have as many times fewer points. The innermost
        has a multiple of 2 `fold` points, so that the triangles are carried onto themselves by `fold` turns.
        """
        radius = self.at(np.linspace(0.0, 1.0, 200))[:, 0]
        around = 2.0 * np.pi * radius.mean()
        best: tuple[float, Rings] | None = None
        for base in range(_LEAST + -_LEAST % (2 * fold), max(_MOST, 2 * fold) + 1, 2 * fold):
            for number in itertools.count(max(4, points // (4 * base))):
                rings = self._rings(base, number)
                if rings.starts[-1] < points:
                    continue
                mean = rings.starts[-1] / rings.number
                uneven = abs(np.log(self.length / (rings.number - 1) * mean / around))
                if best is None or uneven < best[0]:
                    best = (uneven, rings)
                break
        assert best is not None
        return best[1]

    def _rings(self, base: int, number: int) -> Rings:
        """Return rings at even distances, of which the innermost has `base` points."""
        radius = self.at(np.linspace(0.0, 1.0, number))[:, 0]
        closed = self.controls[0][0] == 0.0
        if not closed:
            return Rings((4 * base,) * number, pole=False)
        wanted = np.where(radius < 0.25 * radius.max(), 1, np.where(radius < 0.5 * radius.max(), 2, 4))
        counts = [1]
        for each in wanted[2:]:
            counts.append(min(max(counts[-1], int(each)), 2 * counts[-1]))
        return Rings(tuple(base * each for each in counts), pole=True)


Warp = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From angles, parts of the profile's length and [points, 2] radii and heights to new radii and heights."""


@dataclass(frozen=True, eq=False)
class Turned:
    """A wall that turns about the z axis, and its sides in a body."""

    rings: Rings
    sheet: Sheet
    lower: Int[np.ndarray, " points"]
    """Rows in the body: below where the profile runs outwards, outside where it rises."""
    upper: Int[np.ndarray, " points"]

    @classmethod
    def lay(
        cls,
        body: Body,
        profile: Profile,
        *,
        fold: int = 1,
        points: int = POINTS,
        crowd: float = 0.0,
        warp: Warp | None = None,
        rings: Rings | None = None,
    ) -> "Turned":
        """Add the wall that a profile describes to a body.

        `crowd` moves points around the axis towards angle 0, where they come to lie 1 - crowd as far apart.
        `rings` are chosen for the profile where they are not given.
        """
        rings = profile.rings(fold=fold, points=points) if rings is None else rings
        along = rings.ring / (rings.number - 1)
        values = profile.at(along)
        angles = 2.0 * np.pi * rings.turns
        angles = angles - crowd * np.sin(angles)
        radius, height = values[:, 0], values[:, 1]
        if warp is not None:
            radius, height = warp(angles, along, values[:, :2])
        middle = np.stack([radius * np.cos(angles), radius * np.sin(angles), height], axis=1)
        sheet = Sheet.of(middle, values[:, 2], rings.triangles, rings.order)
        return cls(rings, sheet, *body.lay(sheet))

    def side_patch(self, rings: range, half: int, *, falling: bool = False) -> Patch:
        """Return the outside of these rings within `half` points of angle 0, ring by ring, from below or from above."""
        places = np.arange(-half, half + 1)
        rows = np.concatenate([self.rings.rows(ring, places) for ring in (reversed(rings) if falling else rings)])
        return Patch.of(self.sheet.triangles, self.sheet.order, rows, lower=True)

    def middle_patch(self, last: int, *, lower: bool) -> Patch:
        """Return the rings about the pole up to one."""
        return Patch.of(self.sheet.triangles, self.sheet.order, np.arange(self.rings.starts[last + 1]), lower=lower)

    def outside(self, patch: Patch) -> Float64[np.ndarray, "columns 3"]:
        """Return where a patch's points lie on the lower side, meters."""
        return self.sheet.middle[patch.rows] - self.sheet.offsets[patch.rows]

    def top(self, patch: Patch) -> Float64[np.ndarray, "columns 3"]:
        """Return where a patch's points lie on the upper side, meters."""
        return self.sheet.middle[patch.rows] + self.sheet.offsets[patch.rows]

    def add_foot(self, body: Body, ring: int, bottom: float) -> None:
        """Add a foot under the band between a ring and the next one, down to a height."""
        rows = np.concatenate([np.arange(self.rings.starts[ring], self.rings.starts[ring + 2])])
        patch = Patch.of(self.sheet.triangles, self.sheet.order, rows, lower=True)
        places = self.outside(patch)
        places[:, 2] = bottom
        body.grow(patch.triangles, patch.order, self.lower[patch.rows], places[None])
