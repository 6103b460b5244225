"""Prisms laid side by side and end to end, cut into tetrahedra that fit together."""

import itertools

import numpy as np
import torch
from jaxtyping import Float64, Int

from avmsf.errors import SimulationError
from avmsf.fem.solid import FLATTEST, Solid
from avmsf.simulate.shapes.sheet import Sheet


class Body:
    """A solid in the making.

    A prism over a triangle is cut into three tetrahedra. Each of its four-sided sides is cut from the start of the edge
    whose corner comes first in `order` to the end of the other, so that neighbors cut it alike.
    """

    def __init__(self) -> None:
        self._points: list[np.ndarray] = []
        self._cells: list[np.ndarray] = []
        self._count = 0

    def lay(self, sheet: Sheet) -> tuple[Int[np.ndarray, " points"], Int[np.ndarray, " points"]]:
        """Add a wall of one layer; return the rows of its points on the lower and on the upper side."""
        lower = self.place(sheet.middle - sheet.offsets)
        upper = self.place(sheet.middle + sheet.offsets)
        self._stack(sheet.triangles, sheet.order, np.stack([lower, upper]))
        return lower, upper

    def grow(
        self,
        triangles: Int[np.ndarray, "triangles 3"],
        order: Int[np.ndarray, " columns"],
        start: Int[np.ndarray, " columns"],
        layers: Float64[np.ndarray, "layers columns 3"],
        *,
        end: Int[np.ndarray, " columns"] | None = None,
    ) -> None:
        """Add prisms on top of triangles that are there: from rows `start` through `layers` to rows `end`, if any.

        `triangles` name columns, counter-clockwise seen from where the prisms grow to.
        """
        rows = [start, *(self.place(layer) for layer in layers)]
        self._stack(triangles, order, np.stack(rows if end is None else [*rows, end]))

    def place(self, places: Float64[np.ndarray, "points 3"]) -> Int[np.ndarray, " points"]:
        """Add points; return their rows."""
        self._points.append(places)
        self._count += len(places)
        return np.arange(self._count - len(places), self._count)

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
        edges = points[cells[:, 1:]] - points[cells[:, :1]]
        longest = np.linalg.norm(edges, axis=-1).max(axis=1)
        unfit = np.flatnonzero(~(np.linalg.det(edges) / 6.0 > FLATTEST * longest**3))
        if len(unfit):
            where = ", ".join(f"{value:.3f}" for value in points[cells[unfit[0]]].mean(axis=0))
            raise SimulationError(
                f"expected tetrahedra of positive volume, got {len(unfit)} of {len(cells)} inverted, first at "
                f"({where}) m; use thinner walls or a larger shape",
                row=int(unfit[0]),
                name="cells",
                value=len(unfit),
            )
        return Solid.build(torch.from_numpy(points), torch.from_numpy(cells))

    def _stack(
        self,
        triangles: Int[np.ndarray, "triangles 3"],
        order: Int[np.ndarray, " columns"],
        rows: Int[np.ndarray, "layers columns"],
    ) -> None:
        ranks = np.argsort(order[triangles], axis=1, kind="stable")
        sorted_corners = np.take_along_axis(triangles, ranks, axis=1)
        odd = np.linalg.det(np.eye(3)[ranks]) < 0
        for below, above in itertools.pairwise(rows):
            a, b = below[sorted_corners].T, above[sorted_corners].T
            cells = np.concatenate(
                [np.stack(each, axis=1) for each in ((*a, b[2]), (a[0], a[1], b[2], b[1]), (a[0], b[0], b[1], b[2]))]
            )
            turned = np.tile(odd, 3)
            cells[turned] = cells[turned][:, [0, 2, 1, 3]]
            self.fill(cells)
