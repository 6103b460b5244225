"""A body as tetrahedra."""

from dataclasses import dataclass

from jaxtyping import Float64, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Solid:
    """Straight-edged tetrahedra that fill a body."""

    points: Float64[Tensor, "points 3"]
    """Corners, object frame, metres; every one belongs to a tetrahedron."""
    cells: Int[Tensor, "cells 4"]
    """Rows of `points` at the corners of each tetrahedron, all of positive volume."""
