"""A regular grid of cells around an object."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int


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

    @property
    def diagonal(self) -> float:
        """Diagonal of the box of all cells, meters."""
        return self.spacing * float(np.linalg.norm(self.shape))

    def places(self, rows: Int[np.ndarray, "*cells 3"]) -> Float64[np.ndarray, "*cells 3"]:
        """Return the middles of cells given by their indices, meters."""
        return self.lowest + self.spacing * rows

    def coarser(self, factor: int) -> "Grid":
        """Return a grid that covers this one with cells `factor` times as wide; both have the same first middle."""
        counts = [-(-(count - 1) // factor) + 1 for count in self.shape]
        return Grid(self.lowest, self.spacing * factor, (counts[0], counts[1], counts[2]))
