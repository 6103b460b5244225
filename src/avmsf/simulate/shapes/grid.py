"""Rows and columns of points, joined by triangles: how plates and strips are covered."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int


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
        rising = ((row + column) % 2 == 0)[:, None, None]
        one = np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1)
        other = np.stack([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)], axis=1)
        return np.where(rising, one, other).reshape(-1, 3)
