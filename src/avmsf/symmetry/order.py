"""Orders of axes: how many turns make a whole one, or whether every angle is a symmetry."""

import functools
import math
import statistics
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

from avmsf.symmetry.alignment import SymmetryTest
from avmsf.symmetry.motion import MAX_ORDER, Motion

IMPLIED_TOLERANCE = 1.15
"""Tolerances that what follows from two symmetries may be off: that it is one is known, and where it is. Each single
turn of an order may be off by as much."""
_NEARLY_ROUND = 8
_MIN_CONTRAST, _MIN_ROUND_CONTRAST = 0.2, 0.07
"""How much worse the angles between those of an order must be, in spacings, for the order to mean something: below and
from order 8 on, where a prism is nearly round."""
_INCOMMENSURATE = tuple(2 * math.pi * ((step * (math.sqrt(5) - 1) / 2) % 1.0) for step in range(1, 9))
"""Angles that have no small part of a turn in common: fractions of the golden section."""


def find_order(test: SymmetryTest, turn: Motion, *, tolerance: float) -> Motion:
    """Return an accepted turn with its order, and the axis that fits all turns of that order best.

    The largest order whose turns all hold, and between whose turns others hold less well: a prism of twelve sides
    is nearly round, and yet fits itself best at its own angles. If no order stands out and all angles hold, the
    axis is continuous.
    """

    @functools.cache
    def square(part: Fraction) -> float:
        return test.error(replace(turn, angle=2 * math.pi * part)) ** 2

    orders = [
        order
        for order in range(MAX_ORDER, 1, -1)
        if statistics.fmean(map(square, _turns(order))) < (4 * test.tolerance) ** 2
    ]
    significant = [order for order in orders if _is_significant(square, order)]
    every: list[int | None] = [None] if len(orders) == MAX_ORDER - 1 else []
    for order in [*significant, *every, *orders]:
        found = as_order(test, turn, order, tolerance=tolerance)
        if found is not None:
            return found
    assert turn.angle is not None
    return replace(turn, order=round(2 * math.pi / abs(turn.angle)))


def as_order(test: SymmetryTest, turn: Motion, order: int | None, *, tolerance: float) -> Motion | None:
    """Return a turn moved to where all turns of an order, or any angle, hold best; None where they do not hold."""
    angles = _INCOMMENSURATE if order is None else tuple(2 * math.pi * part for part in _turns(order))
    fitted = test.fit(turn, angles=angles, steps=6, width=0.02)
    errors = [test.error(replace(fitted, angle=angle)) for angle in angles]
    mean = math.sqrt(statistics.fmean(error**2 for error in errors))
    holds = mean <= tolerance and max(errors) <= IMPLIED_TOLERANCE * test.tolerance
    return replace(fitted, angle=angles[0], order=order, error=mean) if holds else None


def _turns(order: int) -> list[Fraction]:
    """Return an order's turns up to the half one, as parts of a whole one; the others are their reverse."""
    return [Fraction(step, order) for step in range(1, order // 2 + 1)]


def _is_significant(square: Callable[[Fraction], float], order: int) -> bool:
    """Return whether an order's turns hold better than those halfway between them."""
    turns = [square(part) for part in _turns(order)]
    between = [square(Fraction(step, 2 * order)) for step in range(1, order + 1, 2)]
    gain = statistics.fmean(between) - statistics.fmean(turns)
    if order < _NEARLY_ROUND:
        return gain > _MIN_CONTRAST**2
    # A small one has to stand clear of what errors differ by from angle to angle.
    chance = 3.0 * math.sqrt(sum(statistics.variance(squares) / len(squares) for squares in (turns, between)))
    return gain > max(_MIN_ROUND_CONTRAST**2, chance)
