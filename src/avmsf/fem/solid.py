"""A body as tetrahedra."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Bool, Float64, Int
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.mesh.surface import Surface

_FACES = torch.tensor([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of a tetrahedron's sides, counter-clockwise from outside; side i lies opposite to corner i."""
_MIN_VOLUME_RATIO = 1e-9
"""Volume of a tetrahedron over the cube of its longest edge, below which it is flat; a regular one has .118."""


@dataclass(frozen=True, eq=False)
class Solid:
    """Straight-edged tetrahedra that fill a body."""

    points: Float64[Tensor, "points 3"]
    """Corners, object frame, meters; every one belongs to a tetrahedron."""
    cells: Int[Tensor, "cells 4"]
    """Rows of `points` at the corners of each tetrahedron, all of positive volume."""

    @classmethod
    def build(cls, points: Float64[Tensor, "points 3"], cells: Int[Tensor, "cells 4"]) -> "Solid":
        """Return the solid with cells turned to positive volume and unused points left out.

        Raises SimulationError where a cell is flat or its coordinates are not finite.
        """
        used, rows = torch.unique(cells, return_inverse=True)
        corners = points[used]
        volumes = _volumes(corners, rows)
        turned = torch.where((volumes < 0)[:, None], rows[:, [0, 2, 1, 3]], rows)
        solid = cls(corners, turned)
        solid.expect_volume()
        return solid

    @cached_property
    def volumes(self) -> Float64[Tensor, " cells"]:
        """Volume of each tetrahedron, cubic meters."""
        return _volumes(self.points, self.cells)

    @property
    def volume(self) -> float:
        """Cubic meters."""
        return float(self.volumes.sum())

    @cached_property
    def size(self) -> float:
        """Diagonal of the box around the body, meters."""
        return float((self.points.amax(dim=0) - self.points.amin(dim=0)).norm())

    @cached_property
    def _sides(self) -> tuple[Int[np.ndarray, " sides"], Int[np.ndarray, " triangles"]]:
        """Number of the triangle that each side of each cell is, and how many sides each triangle is."""
        sides = np.sort(self.cells[:, _FACES].numpy().reshape(-1, 3), axis=1)
        _, which, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
        return which.ravel(), count

    @cached_property
    def outer(self) -> Bool[np.ndarray, " sides"]:
        """Which sides are on the outside, four a cell."""
        which, count = self._sides
        return count[which] == 1

    @property
    def boundary(self) -> Int[Tensor, "triangles 3"]:
        """Rows of `points` at the corners of the outer triangles, counter-clockwise from outside, cell by cell."""
        return self.cells[:, _FACES].reshape(-1, 3)[torch.from_numpy(self.outer)]

    @property
    def surface(self) -> Surface:
        """The outer triangles."""
        used, rows = torch.unique(self.boundary, return_inverse=True)
        return Surface(self.points[used].float(), rows)

    @cached_property
    def parts(self) -> Int[Tensor, " cells"]:
        """Number of the part that each cell belongs to; cells that share a side are of one part, largest first."""
        owners = np.repeat(np.arange(len(self.cells)), 4)
        belongs = scipy.sparse.csr_array((np.ones(len(owners)), (owners, self._sides[0])))
        label = scipy.sparse.csgraph.connected_components(belongs @ belongs.T, directed=False)[1]
        order = np.argsort(-np.bincount(label, weights=self.volumes.numpy()), kind="stable")
        return torch.from_numpy(np.argsort(order)[label])

    def expect_volume(self, *, advice: str = "make the tetrahedra with another detail") -> None:
        """Raise SimulationError where a tetrahedron is flat or inside out, naming the first."""
        longest = (self.points[self.cells][:, :, None] - self.points[self.cells][:, None]).norm(dim=-1).amax(dim=(1, 2))
        unfit = torch.nonzero(~(self.volumes > _MIN_VOLUME_RATIO * longest**3)).flatten()
        if len(unfit):
            row = int(unfit[0])
            volume, middle = float(self.volumes[row]), self.points[self.cells[row]].mean(dim=0).tolist()
            where = ", ".join(f"{value:.3f}" for value in middle)
            got = (
                f"{volume:.3g} m3 with edges up to {float(longest[row]):.3g} m at ({where}) m ({len(unfit)} of "
                f"{len(self.cells)} are flat or inverted)"
            )
            raise SimulationError.expected("a positive volume", volume, got=got, row=row, name="cells", advice=advice)

    def expect_connected(self, *, loose: float = 0.0) -> None:
        """Raise SimulationError where more than a share `loose` of the volume is not of the largest part."""
        volumes = torch.bincount(self.parts, weights=self.volumes)
        if float(volumes[1:].sum()) > loose * float(volumes.sum()):
            raise several_parts("shape", volumes.tolist(), "m3")


def prism_cells(
    triangles: Int[np.ndarray, "triangles 3"],
    order: Int[np.ndarray, " columns"],
    below: Int[np.ndarray, " columns"],
    above: Int[np.ndarray, " columns"],
) -> Int[np.ndarray, "triangles 3 4"]:
    """Return three tetrahedra for each prism over a triangle of columns, counter-clockwise seen from above.

    `below` and `above` are the points of the columns. Each four-sided side is cut from below the column that comes
    first in `order` to above the other, so that neighbors cut it alike; numbers in `order` differ along every edge.
    """
    ranks = np.argsort(order[triangles], axis=1, kind="stable")
    corners = np.take_along_axis(triangles, ranks, axis=1)
    a, b = below[corners].T, above[corners].T
    cells = np.stack([*a, b[2], a[0], a[1], b[2], b[1], a[0], b[0], b[1], b[2]], axis=1).reshape(-1, 3, 4)
    odd = np.linalg.det(np.eye(3)[ranks]) < 0
    cells[odd] = cells[odd][..., [0, 2, 1, 3]]
    return cells


def several_parts(what: str, sizes: Sequence[float], unit: str) -> SimulationError:
    """Return the error of something whose connected parts have these sizes, the largest first."""
    some = ", ".join(f"{size:.3g}" for size in sizes[:4])
    got = f"{len(sizes)} of {some}{', ...' if len(sizes) > 4 else ''} {unit}"
    wanted, advice = f"a connected {what}", "join them, or give one of them"
    return SimulationError.expected(wanted, len(sizes), got=got, name="parts", advice=advice)


def _volumes(points: Float64[Tensor, "points 3"], cells: Int[Tensor, "cells 4"]) -> Float64[Tensor, " cells"]:
    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]
    return (torch.linalg.cross(edges[:, 0], edges[:, 1]) * edges[:, 2]).sum(dim=1) / 6.0
