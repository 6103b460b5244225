"""The test of a candidate, the symmetries found so far, and what follows from two: their composition is a third."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from avmsf.symmetry.alignment import Halves, Motion, fit_motion

MAX_ORDER = 12
_NEARLY_ROUND = 8
_MIN_CONTRAST, _MIN_ROUND_CONTRAST = 0.2, 0.07
"""How much worse the angles between those of an order must be, in spacings, for the order to mean something: below and
from order 8 on, where a prism is nearly round."""
_INCOMMENSURATE = tuple(2 * math.pi * ((step * (math.sqrt(5) - 1) / 2) % 1.0) for step in range(1, 9))
"""Angles that have no small part of a turn in common: fractions of the golden section."""
_IMPLIED_TOLERANCE = 1.15
"""Tolerances that what follows from two symmetries may be off: that it is one is known, and where it is. Each single
turn of an order may be off by as much."""
_SAME_DEGREES, _SAME_GAP = 6.0, 0.03
_CUBE, _ICOSAHEDRON = 13 + 9, 31 + 15
"""Axes and planes of the two."""


@dataclass(frozen=True, eq=False)
class ScoredMotion:
    """A motion and how well it holds."""

    motion: Motion
    error: float
    order: int | None = None
    """Of a turn: how many make a whole one; None for a plane, and where any angle will do."""

    @property
    def continuous(self) -> bool:
        """Whether this is an axis about which every angle is a symmetry."""
        return self.motion.angle is not None and self.order is None


@dataclass(frozen=True, eq=False)
class SymmetryTest:
    """A cloud and the error, in spacings, up to which a motion is a symmetry of it."""

    halves: Halves
    tolerance: float

    def score(self, motion: Motion) -> ScoredMotion:
        """Return how well a motion holds."""
        return ScoredMotion(motion, self.halves.error(motion))

    def refine(self, motion: Motion, *, width: float) -> ScoredMotion:
        """Return a motion moved to where it holds best, first roughly and, where that promises something, finely."""
        fitted = fit_motion(motion, self.halves, queries=300, width=width)
        rough = self.score(fitted)
        if rough.error >= 4 * self.tolerance:
            return rough
        fine = self.score(fit_motion(fitted, self.halves, queries=1500, steps=5, width=0.01))
        return min(rough, fine, key=lambda each: each.error)

    def find_order(self, turn: ScoredMotion, *, tolerance: float) -> ScoredMotion:
        """Return an accepted turn with its order, and the axis that fits all turns of that order best.

        The largest order whose turns all hold, and between whose turns others hold less well: a prism of twelve sides
        is nearly round, and yet fits itself best at its own angles. If no order stands out and all angles hold, the
        axis is continuous.
        """
        assert turn.motion.angle is not None
        errors: dict[float, float] = {}
        orders = [
            order
            for order in range(MAX_ORDER, 1, -1)
            if self._mean_square(turn.motion, _angles(order), errors) < (4 * self.tolerance) ** 2
        ]
        significant = [order for order in orders if self._is_significant(turn.motion, order, errors)]
        round_: list[int | None] = [None] if len(orders) == MAX_ORDER - 1 else []
        for order in [*significant, *round_, *orders]:
            found = self.as_order(turn.motion, order, tolerance=tolerance)
            if found is not None:
                return found
        return ScoredMotion(turn.motion, turn.error, round(2 * math.pi / abs(turn.motion.angle)))

    def as_order(self, motion: Motion, order: int | None, *, tolerance: float) -> ScoredMotion | None:
        """Return a turn moved to where all turns of an order, or any angle, hold best; None where they do not hold."""
        angles = _INCOMMENSURATE if order is None else _angles(order)
        fitted = fit_motion(motion, self.halves, angles=angles, steps=6, width=0.02)
        errors = [self.halves.error(fitted.with_angle(angle)) for angle in angles]
        mean = math.sqrt(sum(error**2 for error in errors) / len(errors))
        holds = mean <= tolerance and max(errors) <= _IMPLIED_TOLERANCE * self.tolerance
        return ScoredMotion(fitted.with_angle(angles[0]), mean, order) if holds else None

    def _is_significant(self, motion: Motion, order: int, errors: dict[float, float]) -> bool:
        """Return whether an order's turns hold better than those halfway between them."""
        turns, between = _angles(order), [math.pi * step / order for step in range(1, order + 1, 2)]
        gain = self._mean_square(motion, between, errors) - self._mean_square(motion, turns, errors)
        if order < _NEARLY_ROUND:
            return gain > _MIN_CONTRAST**2
        # A small one has to stand clear of what errors differ by from angle to angle.
        groups = [[errors[round(angle, 6)] ** 2 for angle in angles] for angles in (turns, between)]
        chance = 3.0 * math.sqrt(sum(statistics.variance(squares) / len(squares) for squares in groups))
        return gain > max(_MIN_ROUND_CONTRAST**2, chance)

    def _mean_square(self, motion: Motion, angles: Sequence[float], errors: dict[float, float]) -> float:
        """Return the mean square error of turns; `errors` keeps what is known by the angle."""
        total = 0.0
        for angle in angles:
            rounded = round(angle, 6)
            if rounded not in errors:
                errors[rounded] = self.halves.error(motion.with_angle(angle))
            total += errors[rounded] ** 2
        return total / len(angles)


@dataclass(eq=False)
class Group:
    """Planes and axes that hold, none of them twice, and the candidates that did not."""

    test: SymmetryTest
    mirrors: list[ScoredMotion] = field(default_factory=list)
    turns: list[ScoredMotion] = field(default_factory=list)
    rejected: list[ScoredMotion] = field(default_factory=list)

    @property
    def continuous(self) -> list[ScoredMotion]:
        """The axes about which every angle is a symmetry."""
        return [each for each in self.turns if each.continuous]

    def knows(self, motion: Motion) -> bool:
        """Return whether a plane or axis is one of those found, or follows from an axis of any angle."""
        if is_ball(self.continuous) or follows(motion, self.continuous):
            return True
        return any(_same(motion, each.motion) for each in (self.mirrors if motion.angle is None else self.turns))

    def consider(self, motion: Motion, *, width: float = 0.05, implied: bool = False) -> None:
        """Move a candidate to its best place and keep it if it holds; one that is `implied` by two may be off more."""
        tolerance = self.test.tolerance * (_IMPLIED_TOLERANCE if implied else 1.0)
        if self.knows(motion):
            return
        refined = self.test.refine(motion, width=width)
        if self.knows(refined.motion):
            return
        if refined.error > tolerance:
            self.rejected.append(refined)
        elif motion.angle is None:
            self.mirrors.append(refined)
        else:
            self._add_turn(self.test.find_order(refined, tolerance=tolerance))

    def complete(self) -> None:
        """Add what follows from pairs of those found, until nothing new does; nothing where there is no end to it."""
        direct = (list(self.mirrors), list(self.turns))
        done: set[tuple[ScoredMotion, ScoredMotion]] = set()
        while not is_ball(self.continuous):
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
        for each in sorted(self.mirrors, key=lambda mirror: mirror.error):
            if each in self.mirrors:
                near = [m for m in self.mirrors if each.motion.separation(m.motion)[0] < 180 / MAX_ORDER - 2]
                worse = [other for other in near if other.error > each.error]
                self.rejected += worse
                self.mirrors = [other for other in self.mirrors if other not in worse]

    def _max_elements(self) -> int:
        """Return how many axes and planes a body can have whose axes are of these orders: a prism, cube or icosahedron.

        What implies more is no group.
        """
        orders = [each.order or 0 for each in self.turns]
        return _ICOSAHEDRON if orders.count(5) > 1 else max(_CUBE, 2 * max(orders, default=0) + 2)

    def _make_continuous(self) -> None:
        """Make an axis continuous where more planes contain it than its order has."""
        for turn in self.turns:
            planes = sum(follows(each.motion, [turn]) for each in self.mirrors)
            if turn.order is not None and planes > turn.order:
                found = self.test.as_order(turn.motion, None, tolerance=_IMPLIED_TOLERANCE * self.test.tolerance)
                if found is not None:
                    self.turns = [each for each in self.turns if each is not turn]
                    self._add_turn(found)
                    return

    def _add_turn(self, turn: ScoredMotion) -> None:
        if turn.continuous:
            # What was found before and follows from this axis is not listed any more.
            self.mirrors = [each for each in self.mirrors if not follows(each.motion, [turn])]
            self.turns = [each for each in self.turns if not follows(each.motion, [turn])]
        self.turns.append(turn)


def follows(motion: Motion, continuous: list[ScoredMotion]) -> bool:
    """Return whether a plane contains, or a half turn's axis crosses, an axis about which every angle is a symmetry."""
    for each in continuous:
        crossing = abs(motion.direction @ each.motion.direction) < 0.1
        if motion.angle is None:
            on_axis = abs(motion.direction @ (motion.point - each.motion.point)) < _SAME_GAP
        else:
            on_axis = abs(abs(motion.angle) - math.pi) < 1e-6
        if crossing and on_axis:
            return True
    return False


def is_ball(continuous: list[ScoredMotion]) -> bool:
    """Return whether two axes of any angle cross: then every axis through that point is one."""
    return any(
        abs(one.motion.direction @ other.motion.direction) < 0.9
        for number, one in enumerate(continuous)
        for other in continuous[:number]
    )


def _angles(order: int) -> tuple[float, ...]:
    """Return an order's turns up to the half one; the others are their reverse."""
    return tuple(2 * math.pi * step / order for step in range(1, order // 2 + 1))


def _same(one: Motion, other: Motion) -> bool:
    degrees, gap = one.separation(other)
    return degrees < _SAME_DEGREES and gap < _SAME_GAP


def _implied(one: ScoredMotion, other: ScoredMotion) -> list[Motion]:
    """Return the image of one plane or axis under the other symmetry, and what both do one after the other."""
    if other.continuous:
        return []
    motions = [one.motion.conjugated_by(other.motion)]
    if not one.continuous:
        first, second = (
            each.motion if each.order is None else each.motion.with_angle(2 * math.pi / each.order)
            for each in (one, other)
        )
        shift = second.apply(first.apply(np.zeros((1, 3))))[0]
        motion = _motion_of(second.linear @ first.linear, shift)
        motions += [] if motion is None else [motion]
    return motions


def _motion_of(linear: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, " 3"]) -> Motion | None:
    """Return x -> L x + t as a reflection or as the least turn of its order about its axis; None if it is neither."""
    if np.linalg.det(linear) < 0.0:
        _, directions = np.linalg.eigh(linear + linear.T)
        normal = directions[:, 0]
        gliding = shift - (shift @ normal) * normal
        if np.abs(linear - (np.eye(3) - 2 * np.outer(normal, normal))).max() > 0.15 or np.abs(gliding).max() > 0.05:
            return None
        return Motion(normal, (shift @ normal / 2) * normal, None)
    turn = Rotation.from_matrix(linear).as_rotvec()
    angle = float(np.linalg.norm(turn))
    fractions = [
        (order, step)
        for order in range(2, MAX_ORDER + 1)
        for step in range(1, order // 2 + 1)
        if math.gcd(order, step) == 1 and abs(angle - 2 * math.pi * step / order) < math.radians(4)
    ]
    if not fractions or abs(turn @ shift) > 0.05 * angle:
        return None
    point = np.linalg.lstsq(np.eye(3) - linear, shift, rcond=0.05)[0]
    order, _ = min(fractions, key=lambda each: abs(angle - 2 * math.pi * each[1] / each[0]))
    return Motion(turn / angle, point, 2 * math.pi / order)
