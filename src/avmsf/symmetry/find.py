"""The symmetries of a cloud of points as planes and axes in its own frame: the largest point group that holds.

It grows from motions that are symmetries each by itself.
"""

import functools
import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.arrays import Seed, generator_of
from avmsf.errors import SceneError
from avmsf.mesh.neighborhoods import NEIGHBORS
from avmsf.symmetry.alignment import SymmetryTest, draw_by_area, local_planes
from avmsf.symmetry.candidates import candidates
from avmsf.symmetry.motions import Motions, Vector, axis_of, rotations
from avmsf.symmetry.point_group import GOLDEN_ANGLES, MAX_ORDER, SAME_DISTANCE, PointGroup, generate
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries

MAX_POINTS = 8000
"""Points of a cloud that are used, at most."""
_MIN_POINTS = 10 * NEIGHBORS


def find_symmetries(points: Float[Tensor, "points 3"], *, seed: Seed = None) -> Symmetries:
    """Return the rotations and mirror planes that carry a cloud of an object's surface onto itself.

    The cloud may be noisy, cover the object unevenly, and lie in any pose. At most `MAX_POINTS` points are used, drawn
    so that dense parts lose most. What is returned is one point group, the largest that holds: candidates come from the
    principal axes and from pairs of points with similar surfaces around them, and those that hold generate groups.

    **The error.** Each quarter of the points is moved onto the surface that the others sample. The error is the root
    mean square of their distances from it, without what the distances are when nothing is moved (noise), in spacings of
    three quarters; a spacing below 1 or above 1.6 % of the object's diagonal counts as that. A distance counts up to 3
    spacings. So the tolerance of .38 lets the whole surface be off by that many spacings, or (.38 / 3)^2 = 1.6 % of it
    have no counterpart at all. It holds for the mean over a group; each motion may have 1.15 times the error. Where the
    points are so few or noisy that chance changes squared errors by more than the tolerance, or where they fill a
    volume and show no surface, no symmetry is returned.

    An object that is damaged, or of which large parts are in no view, has only the symmetries of what is there.

    Orders 2 to 12 are distinguished; an axis is continuous if every angle holds and no order holds better than the
    angles between its turns. Planes that contain a continuous axis and half turns across it follow from it and are not
    listed; of a ball, two of its axes are. Raises SceneError for points that are too few (240), not finite, or on one
    line.
    """
    random = np.random.default_rng(int(torch.randint(2**31 - 1, (1,), generator=generator_of(seed))))
    places, middle, diagonal = _normalized(points)
    if len(places) > MAX_POINTS:
        places = places[draw_by_area(local_planes(places), MAX_POINTS, random, max_ratio=9.0)]
    test = SymmetryTest(places, random)
    group, rejected = None, [math.inf]
    if test.tolerance > 0.0:
        group, outside = find_group(test, candidates(test.surface, test.queries, random))
        rejected += outside

    turns: list[RotationalSymmetry] = []
    mirrors: list[MirrorSymmetry] = []
    if group is not None:
        center = group.motions.center()
        for axis, order, rows in group.axes():
            foot = torch.from_numpy(middle + diagonal * (center - (center @ axis) * axis))
            turns.append(RotationalSymmetry(_signed(axis), foot, order, _root(group.squares[rows].mean())))
        for normal, row in group.planes():
            foot = torch.from_numpy(middle + diagonal * (center @ normal) * normal)
            mirrors.append(MirrorSymmetry(_signed(normal), foot, _root(group.squares[row])))
    turns.sort(key=lambda each: (each.order is not None, -(each.order or 0), each.error))
    mirrors.sort(key=lambda each: each.error)
    return Symmetries(tuple(turns), tuple(mirrors), test.spacing * diagonal, test.tolerance, _root(min(rejected)))


def _root(square: float) -> float:
    """Return an error from its square, which chance makes negative for a symmetry as often as positive."""
    return math.sqrt(max(square, 0.0))


def _signed(direction: Vector) -> Float[Tensor, " 3"]:
    """Return the one of two opposite vectors whose largest number is positive."""
    return torch.from_numpy(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def _normalized(
    points: Float[Tensor, "points 3"],
) -> tuple[Float[np.ndarray, "points 3"], Float[np.ndarray, " 3"], float]:
    """Return the points about their middle in units of their diagonal, and both."""
    _expect_enough(len(points))
    wrong = torch.nonzero(~torch.isfinite(points).all(dim=1)).flatten()
    if len(wrong):
        row = int(wrong[0])
        raise SceneError.expected("finite coordinates", points[row].tolist(), row=row, name="points")
    places = points.detach().double().cpu().numpy()
    middle = places.mean(axis=0)
    _, extent, axes = np.linalg.svd(places - middle, full_matrices=False)
    if extent[1] < 1e-3 * extent[0] or extent[0] == 0.0:
        wanted = "points all over an object's surface, not on one line or at one position"
        got = f"{len(points)} with an extent of {extent[0]:.3g}, {extent[1]:.3g} and {extent[2]:.3g} m"
        raise SceneError.expected(wanted, extent.tolist(), got=got, name="points")
    # To each of several points in one place no area falls.
    places = places[np.sort(np.unique(places, axis=0, return_index=True)[1])]
    _expect_enough(len(places))
    # A box along the principal axes: the diagonal must not depend on how the object lies.
    diagonal = float(np.linalg.norm(np.ptp((places - middle) @ axes.T, axis=0)))
    return (places - middle) / diagonal, middle, diagonal


def _expect_enough(count: int) -> None:
    """Raise SceneError for too few points."""
    if count < _MIN_POINTS:
        wanted = f"at least {_MIN_POINTS} points of a surface to find symmetries"
        advice = "draw more points from it, or reconstruct with more Gaussians"
        raise SceneError.expected(wanted, count, name="points", advice=advice)


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
    """Return how much better each order's turns hold than those halfway between, in parts of what is significant."""
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
