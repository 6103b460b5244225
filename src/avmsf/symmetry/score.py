"""Whether a motion is a symmetry of the cloud, and of which order a turn is."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from avmsf.symmetry.alignment import Halves
from avmsf.symmetry.motions import Motion
from avmsf.symmetry.refinement import fit_motion

HIGHEST_ORDER = 12
MISSING = 0.45
"""Part of the surface that may fall into holes: of an object of which 30 % are missing, 43 % of what is left."""
_NEARLY_ROUND = 8
_CONTRAST, _FAINT_CONTRAST = 0.2, 0.07
"""How much worse the angles between those of an order must be, in spacings, for the order to mean something: below and
from order 8 on, where a prism is nearly round."""
_HOLED_CONTRAST = 0.5
"""The same for orders 2 and 3 where holes are: too few angles to say what they differ by."""
_INCOMMENSURATE = tuple(2 * math.pi * ((step * (math.sqrt(5) - 1) / 2) % 1.0) for step in range(1, 9))
"""Angles that have no small part of a turn in common: fractions of the golden section."""
_MISSING_SLACK = 4 / 3
"""Most by which slack raises the part that may be missing."""
_FIRM_SLACK = 1.15
"""Most that slack lets pass where there are no holes."""
_SPARED, _HOLED = 2, 0.05
"""How many of those angles may go wrong where more than this part falls into holes: a hole may be misjudged."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A motion and how well it holds."""

    motion: Motion
    error: float
    missing: float
    order: int | None = None
    """Of a turn: how many make a whole one; None for a plane, and where any angle will do."""

    @property
    def continuous(self) -> bool:
        """Whether this is an axis about which every angle is a symmetry."""
        return self.motion.angle is not None and self.order is None


@dataclass(frozen=True, eq=False)
class Judge:
    """A cloud and how strictly motions of it are judged."""

    halves: Halves
    tolerance: float
    missing: float = MISSING
    """Part of the surface that may have its counterpart in a hole."""

    def judge(self, motion: Motion) -> Judged:
        """Return how well a motion holds."""
        found = self.halves.align(motion)
        return Judged(motion, found.error, found.missing)

    def holds(self, judged: Judged, *, slack: float = 1.0) -> bool:
        """Return whether a motion counts as a symmetry: what was seen of it less has to fit all the better.

        `slack` lets more error pass where there are holes, by whose borders errors are uncertain.
        """
        slack = slack if judged.missing > _HOLED else min(slack, _FIRM_SLACK)
        limit = slack * self.tolerance * (1.0 - judged.missing)
        return judged.missing <= min(slack, _MISSING_SLACK) * self.missing and judged.error <= limit

    def settle(self, motion: Motion, *, width: float, slack: float = 1.0) -> Judged:
        """Return a motion moved to where it holds best, first roughly and, where that promises something, finely."""
        fitted = fit_motion(motion, self.halves, queries=300, width=width)
        judged = self.judge(fitted)
        if judged.error < 2 * slack * self.tolerance:
            finer = self.judge(fit_motion(fitted, self.halves, queries=1500, steps=5, width=0.01))
            judged = min(judged, finer, key=lambda each: each.error)
        return judged

    def find_order(self, judged: Judged, *, slack: float = 1.0) -> Judged:
        """Return an accepted turn with its order, and the axis that fits all turns of that order best.

        The largest order whose turns all hold, and between whose turns others hold less well: a prism of twelve sides
        is nearly round, and yet fits itself best at its own angles. If no order stands out and all angles hold, the
        axis is continuous.
        """
        assert judged.motion.angle is not None
        first = round(2 * math.pi / abs(judged.motion.angle))
        errors: dict[float, float] = {}
        orders = [
            order
            for order in range(HIGHEST_ORDER, 1, -1)
            if self._mean_square(judged.motion, _angles(order), errors) < (2 * slack * self.tolerance) ** 2
        ]
        standing = [order for order in orders if self._stands_out(judged, order, errors)]
        round_ = len(orders) == HIGHEST_ORDER - 1
        anything: list[int | None] = [None] if round_ else []
        for order in [*standing, *anything, *orders]:
            found = self.as_order(judged.motion, order, slack=slack)
            if found is not None:
                return found
        return Judged(judged.motion, judged.error, judged.missing, first)

    def as_order(self, motion: Motion, order: int | None, *, slack: float = 1.0) -> Judged | None:
        """Return a turn moved to where all turns of an order, or any angle, hold best; None where they do not hold."""
        angles = _INCOMMENSURATE if order is None else _angles(order)
        fitted = fit_motion(motion, self.halves, angles=angles, steps=6, width=0.02)
        each = sorted((self.judge(fitted.turning(angle)) for angle in angles), key=lambda one: one.error)
        if order is None and max(one.missing for one in each) > _HOLED:
            each = each[:-_SPARED]
        together = _together(fitted.turning(angles[0]), each, order)
        holds = self.holds(together, slack=slack) and all(self.holds(one, slack=2 * slack) for one in each)
        return together if holds else None

    def _stands_out(self, judged: Judged, order: int, errors: dict[float, float]) -> bool:
        """Return whether an order's turns hold better than those halfway between them."""
        turns, between = _angles(order), [math.pi * step / order for step in range(1, order + 1, 2)]
        means = [self._mean_square(judged.motion, angles, errors) for angles in (between, turns)]
        holed = judged.missing > _HOLED
        least = _FAINT_CONTRAST if order >= _NEARLY_ROUND and not holed else _CONTRAST
        if order >= _NEARLY_ROUND or (holed and min(len(turns), len(between)) > 1):
            # A faint one has to stand clear of what errors differ by from angle to angle, as they do where holes are.
            groups = [[errors[round(angle, 6)] ** 2 for angle in angles] for angles in (turns, between)]
            chance = 3.0 * math.sqrt(sum(statistics.variance(squares) / len(squares) for squares in groups))
        else:
            chance = _HOLED_CONTRAST**2 if holed else 0.0
        return means[0] - means[1] > max(least**2, chance)

    def _mean_square(self, motion: Motion, angles: Sequence[float], errors: dict[float, float]) -> float:
        """Return the mean square error of turns; `errors` keeps what is known by the angle."""
        total = 0.0
        for angle in angles:
            rounded = round(angle, 6)
            if rounded not in errors:
                errors[rounded] = self.judge(motion.turning(angle)).error
            total += errors[rounded] ** 2
        return total / len(angles)


def _angles(order: int) -> tuple[float, ...]:
    """Return an order's turns up to the half one; the others are their reverse."""
    return tuple(2 * math.pi * step / order for step in range(1, order // 2 + 1))


def _together(motion: Motion, each: list[Judged], order: int | None) -> Judged:
    error = math.sqrt(sum(one.error**2 for one in each) / len(each))
    return Judged(motion, error, sum(one.missing for one in each) / len(each), order)
