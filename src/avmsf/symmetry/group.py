"""The symmetries found so far, and what follows from two of them: their composition is a third."""

import math

from avmsf.symmetry.alignment import SymmetryTest
from avmsf.symmetry.motion import MAX_ORDER, Motion
from avmsf.symmetry.order import IMPLIED_TOLERANCE, as_order, find_order

_CUBE, _ICOSAHEDRON = 13 + 9, 31 + 15
"""Axes and planes of the two."""


class SymmetryGroup:
    """Planes and axes that hold, none of them twice, and the candidates that did not."""

    def __init__(self, test: SymmetryTest) -> None:
        self.test = test
        self.mirrors: list[Motion] = []
        self.turns: list[Motion] = []
        self.rejected: list[Motion] = []

    def knows(self, motion: Motion) -> bool:
        """Return whether a plane or axis is one of those found, or follows from an axis of any angle."""
        if self._is_ball() or self._follows(motion):
            return True
        return any(motion.is_near(each) for each in (self.mirrors if motion.angle is None else self.turns))

    def consider(self, motion: Motion, *, width: float = 0.05, implied: bool = False) -> None:
        """Move a candidate to its best place and keep it if it holds; one that is `implied` by two may be off more."""
        tolerance = self.test.tolerance * (IMPLIED_TOLERANCE if implied else 1.0)
        if self.knows(motion):
            return
        refined = self.test.refine(motion, width=width)
        if self.knows(refined):
            return
        if refined.error > tolerance:
            self.rejected.append(refined)
        elif motion.angle is None:
            self.mirrors.append(refined)
        else:
            self._add_turn(find_order(self.test, refined, tolerance=tolerance))

    def complete(self) -> None:
        """Add what follows from pairs of those found, until nothing new does; nothing where there is no end to it."""
        direct = (list(self.mirrors), list(self.turns))
        done: set[tuple[Motion, Motion]] = set()
        while not self._is_ball():
            found = [*self.mirrors, *self.turns]
            pairs = [(one, other) for one in found for other in found if one is not other and (one, other) not in done]
            if not pairs:
                return
            self._make_continuous()
            if len(self.mirrors) + len(self.turns) > self._max_elements():
                self.mirrors, self.turns = direct
                return
            for one, other in pairs:
                done.add((one, other))
                for motion in _implied(one, other):
                    self.consider(motion, width=0.02, implied=True)

    def drop_crowded_mirrors(self) -> None:
        """Drop the worse of planes that cross at less than 15 degrees, which an axis of at most 12 turns lacks."""
        chosen: list[Motion] = []
        for each in sorted(self.mirrors, key=lambda mirror: mirror.error):
            crowded = any(each.is_near(better, 180 / MAX_ORDER - 2, math.inf) for better in chosen)
            (self.rejected if crowded else chosen).append(each)
        self.mirrors = [each for each in self.mirrors if each in chosen]

    def _max_elements(self) -> int:
        """Return how many axes and planes a body can have whose axes are of these orders: a prism, cube or icosahedron.

        What implies more is no group.
        """
        orders = [each.order or 0 for each in self.turns]
        return _ICOSAHEDRON if orders.count(5) > 1 else max(_CUBE, 2 * max(orders, default=0) + 2)

    def _make_continuous(self) -> None:
        """Make an axis continuous where more planes contain it than its order has."""
        for turn in self.turns:
            if turn.order is not None and sum(each.follows(turn) for each in self.mirrors) > turn.order:
                found = as_order(self.test, turn, None, tolerance=IMPLIED_TOLERANCE * self.test.tolerance)
                if found is not None:
                    self.turns.remove(turn)
                    self._add_turn(found)
                    return

    def _add_turn(self, turn: Motion) -> None:
        self.turns.append(turn)
        if turn.continuous:
            # What was found before and follows from this axis is not listed any more.
            self.mirrors = [each for each in self.mirrors if not each.follows(turn)]
            self.turns = [each for each in self.turns if not each.follows(turn)]

    def _follows(self, motion: Motion) -> bool:
        return any(motion.follows(each) for each in self.turns if each.continuous)

    def _is_ball(self) -> bool:
        """Return whether two axes of any angle cross: then every axis through that point is one."""
        axes = [each.direction for each in self.turns if each.continuous]
        return any(abs(one @ other) < 0.9 for number, one in enumerate(axes) for other in axes[:number])


def _implied(one: Motion, other: Motion) -> list[Motion]:
    """Return the image of one plane or axis under the other symmetry, and what both do one after the other."""
    if other.continuous:
        return []
    image = one.conjugated_by(other)
    product = None if one.continuous else other.least_turn().after(one.least_turn())
    return [image] if product is None else [image, product]
