"""What the makers of all kinds of shapes share."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avmsf.simulate.shapes.body import Body
from avmsf.simulate.shapes.shape import Symmetry


@dataclass(frozen=True, eq=False)
class Draft:
    """A shape without its colors."""

    body: Body
    wall: float
    """Nominal thickness, meters."""
    symmetry: Symmetry


Maker = Callable[[np.random.Generator, float | None], Draft]
"""Draws the proportions of one individual; walls as thick as told, meters, or drawn too."""


def drawn_wall(random: np.random.Generator, low: float, high: float, wall: float | None) -> float:
    """Return the wall that was asked for, or one between two bounds, meters; draws in both cases."""
    drawn = random.uniform(low, high)
    return drawn if wall is None else wall
