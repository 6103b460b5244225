"""The symmetries found so far, and what follows from them: two symmetries one after the other are a third."""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from avmsf.symmetry.motions import Motion
from avmsf.symmetry.score import HIGHEST_ORDER, Judge, Judged

_ALIKE_DEGREES, _ALIKE_GAP = 6.0, 0.03
_RESPECTED, _FILLED = 0.02, 0.12
"""Part of the surface that falls into holes up to which a symmetry respects them, and from which on it fills them."""
_PLAIN = 1.3
"""Error, in tolerances, from which on a motion that fills few holes plainly does not hold."""
_CUBE, _ICOSAHEDRON = 13 + 9, 31 + 15
"""Axes and planes of the two."""
_IMPLIED_SLACK = 2.0
"""How much more error is let pass in what follows from two symmetries: that it is one is known, and where it is."""


class Group:
    """Planes and axes that hold, none of them twice, and the candidates that did not."""

    def __init__(self, judge: Judge) -> None:
        self.judge = judge
        self.mirrors: list[Judged] = []
        self.turns: list[Judged] = []
        self.rejected: list[Judged] = []

    @property
    def continuous(self) -> list[Judged]:
        """The axes about which every angle is a symmetry."""
        return [each for each in self.turns if each.continuous]

    def knows(self, motion: Motion) -> bool:
        """Return whether a plane or axis is one of those found, or follows from an axis of any angle."""
        if is_ball(self.continuous) or follows(motion, self.continuous):
            return True
        return any(_alike(motion, each.motion) for each in (self.mirrors if motion.angle is None else self.turns))

    def consider(self, motion: Motion, *, width: float = 0.05, slack: float = 1.0) -> None:
        """Move a candidate to its best place and keep it if it holds."""
        if self.knows(motion):
            return
        judged = self.judge.settle(motion, width=width, slack=slack)
        if self.knows(judged.motion):
            return
        if not self.judge.holds(judged, slack=slack):
            self.rejected.append(judged)
            return
        if motion.angle is None:
            self.mirrors.append(judged)
            return
        self._add_turn(self.judge.find_order(judged, slack=slack))

    def complete(self) -> None:
        """Add what follows from pairs of those found, until nothing new does; nothing where there is no end to it."""
        direct = (list(self.mirrors), list(self.turns))
        done: set[tuple[Judged, Judged]] = set()
        while not is_ball(self.continuous):
            pairs = [
                (one, other)
                for one in [*self.mirrors, *self.turns]
                for other in [*self.mirrors, *self.turns]
                if one is not other and (one, other) not in done
            ]
            if not pairs:
                return
            self._round()
            if len(self.mirrors) + len(self.turns) > self._most():
                self.mirrors, self.turns = direct
                return
            for one, other in pairs:
                done.add((one, other))
                for motion in _implied(one, other):
                    self.consider(motion, width=0.02, slack=_IMPLIED_SLACK)

    def leave_openings(self) -> None:
        """Drop what would fill an opening that a turn, or two planes, carry onto itself: damage respects no symmetry.

        A can without a lid is half of a longer can that is closed at both ends, but for this. One plane alone may pass
        through the middle of a damage by chance.
        """
        planes, turns = ([each for each in found if each.missing < _RESPECTED] for found in (self.mirrors, self.turns))
        if turns or len(planes) > 1:
            self._drop([each for each in [*self.mirrors, *self.turns] if each.missing > _FILLED])

    def leave_contradictions(self) -> None:
        """Drop what together with a symmetry that fills fewer holes would imply something that plainly does not hold.

        A can with a handle seems to turn upside down, into a longer can, about any axis; two such turns would turn it
        about its own axis, which the handle forbids. Of planes that cross at less than 15 degrees, which an axis of at
        most 12 turns does not have, only the better one is kept.
        """
        for each in sorted(self.mirrors, key=lambda mirror: mirror.error):
            if each in self.mirrors:
                self._drop([other for other in self.mirrors if other.error > each.error and _too_near(each, other)])
        found = sorted([*self.mirrors, *self.turns], key=lambda each: each.missing)
        kept: list[Judged] = []
        for each in found:
            if each.missing <= _FILLED or not any(self._contradict(each, other) for other in kept):
                kept.append(each)
        self._drop([each for each in found if each not in kept])

    def _contradict(self, one: Judged, other: Judged) -> bool:
        for motion in _implied(one, other) + _implied(other, one):
            if not self.knows(motion):
                judged = self.judge.settle(motion, width=0.02, slack=_IMPLIED_SLACK)
                if judged.missing < _FILLED and judged.error > _PLAIN * self.judge.tolerance:
                    return True
        return False

    def _drop(self, wrong: list[Judged]) -> None:
        self.rejected += wrong
        self.mirrors = [each for each in self.mirrors if each not in wrong]
        self.turns = [each for each in self.turns if each not in wrong]

    def _most(self) -> int:
        """Return how many axes and planes a body can have whose axes are of these orders: a prism, cube or icosahedron.

        What implies more is no group.
        """
        orders = [each.order or 0 for each in self.turns]
        return _ICOSAHEDRON if orders.count(5) > 1 else max(_CUBE, 2 * max(orders, default=0) + 2)

    def _round(self) -> None:
        """Make an axis continuous where more planes contain it than its order has."""
        for turn in self.turns:
            planes = sum(follows(each.motion, [turn]) for each in self.mirrors)
            if turn.order is not None and planes > turn.order:
                found = self.judge.as_order(turn.motion, None, slack=_IMPLIED_SLACK)
                if found is not None:
                    self.turns = [each for each in self.turns if each is not turn]
                    self._add_turn(found)
                    return

    def _add_turn(self, turn: Judged) -> None:
        if turn.continuous:
            # What was found before and follows from this axis is not listed any more.
            self.mirrors = [each for each in self.mirrors if not follows(each.motion, [turn])]
            self.turns = [each for each in self.turns if not follows(each.motion, [turn])]
        self.turns.append(turn)


def follows(motion: Motion, continuous: list[Judged]) -> bool:
    """Return whether a plane contains, or a half turn's axis crosses, an axis about which every angle is a symmetry."""
    for each in continuous:
        crossing = abs(motion.direction @ each.motion.direction) < 0.1
        if motion.angle is None:
            on_axis = abs(motion.direction @ (motion.point - each.motion.point)) < _ALIKE_GAP
        else:
            on_axis = abs(abs(motion.angle) - math.pi) < 1e-6
        if crossing and on_axis:
            return True
    return False


def is_ball(continuous: list[Judged]) -> bool:
    """Return whether two axes of any angle cross: then every axis through that point is one."""
    return any(
        abs(one.motion.direction @ other.motion.direction) < 0.9
        for number, one in enumerate(continuous)
        for other in continuous[:number]
    )


def _too_near(one: Judged, other: Judged) -> bool:
    return one.motion.apart(other.motion, np.zeros(3))[0] < 180 / HIGHEST_ORDER - 2


def _implied(one: Judged, other: Judged) -> list[Motion]:
    """Return the image of one plane or axis under the other symmetry, and what both do one after the other."""
    if other.continuous:
        return []
    motions = [one.motion.under(other.motion)]
    if not one.continuous:
        first, second = (
            each.motion if each.order is None else each.motion.turning(2 * math.pi / each.order)
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
        for order in range(2, HIGHEST_ORDER + 1)
        for step in range(1, order // 2 + 1)
        if math.gcd(order, step) == 1 and abs(angle - 2 * math.pi * step / order) < math.radians(4)
    ]
    if not fractions or abs(turn @ shift) > 0.05 * angle:
        return None
    point = np.linalg.lstsq(np.eye(3) - linear, shift, rcond=0.05)[0]
    order, _ = min(fractions, key=lambda each: abs(angle - 2 * math.pi * each[1] / each[0]))
    return Motion(turn / angle, point, 2 * math.pi / order)


def _alike(one: Motion, other: Motion) -> bool:
    degrees, gap = one.apart(other, np.zeros(3))
    return degrees < _ALIKE_DEGREES and gap < _ALIKE_GAP
