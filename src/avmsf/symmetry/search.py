"""The largest point group of a cloud, grown from motions that are symmetries each by itself."""

import functools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from avmsf.symmetry.alignment import SymmetryTest
from avmsf.symmetry.motions import Motions, axis_of, rotations
from avmsf.symmetry.point_group import GOLDEN_ANGLES, MAX_ORDER, SAME_DISTANCE, PointGroup, generate

_NEARLY_ROUND = 8
_MIN_CONTRAST, _MIN_ROUND_CONTRAST = 0.2, 0.07
"""How much worse the angles between those of an order must be, in spacings, for the order to mean something: below and
from order 8 on, where a prism is nearly round. They were chosen on the shapes of the benchmark of symmetries."""
_MAX_STARTS = 8
"""Groups that are grown at most; of dense clouds the first nearly always has all that holds."""


def find_group(test: SymmetryTest, candidates: Iterable[Motions]) -> tuple[PointGroup | None, list[float]]:
    """Return the largest group that holds, None if no motion does, and the squared errors of candidates outside.

    Each candidate is moved to where it holds best. Those that hold generate a group each. The largest of these grows by
    the others, as long as what they generate together holds too; one that does not fit is where another group begins to
    grow, unless an axis is continuous: then no group is larger.
    """
    refined: list[tuple[Motions, float]] = []
    for candidate in candidates:
        if not _is_near(candidate, refined):
            motion, square = test.refine(candidate)
            if not _is_near(motion, refined):
                refined.append((motion, square))
    parts: list[PointGroup] = []
    for motion, square in sorted(refined, key=lambda each: each[1]):
        if square <= test.tolerance**2 and not any(part.contains(motion) for part in parts):
            found = _generated(test, motion)
            parts += [found] if found is not None else []
    parts.sort(key=PointGroup.rank)
    grown: list[PointGroup] = []
    for part in parts:
        if len(grown) < _MAX_STARTS and not any(each.continuous or each.contains(part.motions) for each in grown):
            grown.append(_grow(test, part, parts))
    best = min(grown, key=PointGroup.rank, default=None)
    return best, [square for motion, square in refined if best is None or not best.contains(motion)]


def _grow(test: SymmetryTest, group: PointGroup, parts: Sequence[PointGroup]) -> PointGroup:
    """Return a group grown by each of the others with which it generates one that holds."""
    for part in parts:
        if not group.contains(part.motions):
            axis = next((axis for each in (group, part) for axis, order, _ in each.axes() if order is None), None)
            group = _fitted(test, generate(Motions.joined([group.motions, part.motions]), axis)) or group
    return group


def _generated(test: SymmetryTest, motion: Motions) -> PointGroup | None:
    """Return the group of a reflection, or of all turns about a turn's axis; None if it does not hold.

    The largest order whose turns all hold, and between whose turns others hold less well: a prism of twelve sides
    is nearly round, and yet fits itself best at its own angles. If no order stands out and all angles hold, the
    axis is continuous.
    """
    if np.linalg.det(motion.linear[0]) < 0:
        return _fitted(test, generate(motion))
    turns = Motions.about(motion.center(), rotations(axis_of(motion.linear[0]), GOLDEN_ANGLES))
    continuous = _fitted(test, generate(turns, axis_of(motion.linear[0])))
    fitted = motion if continuous is None else continuous.motions
    axis, center = axis_of(fitted.linear[0]), fitted.center()

    @functools.cache
    def square(part: Fraction) -> float:
        return float(test.squared_errors(Motions.about(center, rotations(axis, [2 * math.pi * part])))[0])

    evidence = _evidence_of_orders(square, test)
    significant = [order for order, value in evidence.items() if value > 1.0]
    others = sorted(evidence.keys() - significant, key=lambda order: -evidence[order])
    for order in significant if continuous is not None else [*significant, *others]:
        turns = Motions.about(center, rotations(axis, [2 * math.pi * step / order for step in range(1, order)]))
        found = _fitted(test, generate(turns))
        if found is not None:
            return found
    return continuous


def _fitted(test: SymmetryTest, group: PointGroup | None) -> PointGroup | None:
    """Return a group where it fits best; None if it is none, or is far from holding before, or does not hold then."""
    if group is None or test.squared_errors(group.motions).mean() >= (4 * test.tolerance) ** 2:
        return None
    motions = test.fit(group.motions)
    squares = test.squared_errors(motions)
    return replace(group, motions=motions, squares=squares) if test.holds(squares) else None


def _evidence_of_orders(square: Callable[[Fraction], float], test: SymmetryTest) -> dict[int, float]:
    """Return how much better each order's turns hold than those halfway between, in parts of what is significant.

    The largest order is the first. `square` gives the squared error of a part of a whole turn. Orders whose turns are
    far from holding are left out.
    """
    evidence = {}
    for order in range(MAX_ORDER, 1, -1):
        # Turns by more than a half are the reverse of others.
        turns = [square(Fraction(step, order)) for step in range(1, order // 2 + 1)]
        if statistics.fmean(turns) < (4 * test.tolerance) ** 2:
            between = [square(Fraction(step, 2 * order)) for step in range(1, order + 1, 2)]
            gain = statistics.fmean(between) - statistics.fmean(turns)
            chance = 3.0 * test.noise_error * math.sqrt(1 / len(turns) + 1 / len(between))
            least = _MIN_CONTRAST if order < _NEARLY_ROUND else _MIN_ROUND_CONTRAST
            evidence[order] = gain / max(least**2, chance)
    return evidence


def _is_near(motion: Motions, others: Iterable[tuple[Motions, float]]) -> bool:
    return any(motion.distances(other)[0] < SAME_DISTANCE for other, _ in others)
