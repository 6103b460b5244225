"""Rings of points around a pole, joined by triangles: how discs, cups and tubes are covered."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int


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
