"""Groups of an object's symmetries, and their real characters: the signs that a function may keep under each motion.

Groups are those of each mirror, of each turn, and of each two mirrors or half turns that commute (Serre, Linear
Representations of Finite Groups, 1977, section 2).
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.symmetry.symmetries import Symmetries

TURNS = 12
"""Order that stands for a turn by any angle: waves up to half as many around the axis are told apart."""
_MAX_SINE = math.sin(math.radians(7.5))
"""Sine of the angle up to which lines are parallel or perpendicular: axes of groups up to order 12 are 15 degrees
apart, so that no other lies nearer."""


@dataclass(frozen=True, eq=False)
class Group:
    """Motions that carry an object onto itself, and the characters of the group that they form."""

    motions: Float64[Tensor, "order 3 4"]
    """A point x goes to A x + b, [A b] being the motion, A orthogonal, b in meters. The first one is the identity."""
    characters: Float64[Tensor, "characters order"]
    """Of each motion. The first is one everywhere."""


def groups_of(symmetries: Symmetries) -> tuple[Group, ...]:
    """Return the groups that an object's symmetries form; none where it has none beyond doubt."""
    planes = [(each.normal.double(), -1.0) for each in symmetries.mirrors]
    axes = [(each.axis.double(), 1.0) for each in symmetries.rotations]
    orders = [TURNS if each.order is None else each.order for each in symmetries.rotations]
    points = [each.point.double() for each in symmetries.mirrors]
    points += [each.point.double() for each in symmetries.rotations]
    if not points:
        return ()
    center = _center(torch.stack(points), torch.stack([_flip(*line) for line in (*planes, *axes)]))
    found = [([_flip(*plane)], _SIGNS) for plane in planes]
    found += [(_turns(axis, order), _cyclic(order)) for (axis, _), order in zip(axes, orders, strict=True)]
    flips = planes + [axis for axis, order in zip(axes, orders, strict=True) if order % 2 == 0]
    found += [(each, torch.kron(_SIGNS, _SIGNS)) for each in _pairs(flips)]
    groups = []
    for moved, characters in found:
        linear = torch.stack([_ONE, *moved])
        groups.append(Group(torch.cat([linear, (center - linear @ center)[..., None]], dim=2), characters))
    return tuple(groups)


_ONE = torch.eye(3, dtype=torch.float64)
_SIGNS = torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
"""The characters of a group of two."""


def _flip(line: Float64[Tensor, " 3"], sign: float) -> Float64[Tensor, "3 3"]:
    """Return the half turn about a line (sign 1), or the mirror whose normal it is (sign -1)."""
    return sign * (2.0 * torch.outer(line, line) - _ONE)


def _turns(axis: Float64[Tensor, " 3"], order: int) -> list[Float64[Tensor, "3 3"]]:
    """Return all turns of an axis but the identity."""
    cross = torch.linalg.cross(axis.expand(3, 3), _ONE).T
    angles = [2.0 * math.pi * step / order for step in range(1, order)]
    return [_ONE + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross for angle in angles]


def _cyclic(order: int) -> Float64[Tensor, "characters order"]:
    """Return the real characters of a turn's group: waves of each number around the axis."""
    step = torch.arange(order, dtype=torch.float64)
    return torch.cos(2.0 * math.pi / order * torch.outer(step[: order // 2 + 1], step))


def _pairs(flips: Sequence[tuple[Float64[Tensor, " 3"], float]]) -> list[list[Float64[Tensor, "3 3"]]]:
    """Return what every two flips that commute form with their product, each group once.

    Lines that were found are off by a degree or so. Their nearest perpendicular or common ones are taken, so that the
    flips commute exactly.
    """
    found: list[list[Tensor]] = []
    for (line, sign), (other, other_sign) in itertools.combinations(flips, 2):
        cosine = float(line @ other)
        if abs(cosine) <= _MAX_SINE:
            left, _, right = torch.linalg.svd(torch.stack([line, other]), full_matrices=False)
            one, two = left @ right
        elif 1.0 - cosine**2 <= _MAX_SINE**2:
            one = two = torch.nn.functional.normalize(line + math.copysign(1.0, cosine) * other, dim=0)
        else:
            continue
        first, second = _flip(one, sign), _flip(two, other_sign)
        group = [second, first, first @ second]
        if not any(_same(group, known) for known in found):
            found.append(group)
    return found


def _same(group: Sequence[Tensor], other: Sequence[Tensor]) -> bool:
    """Return whether two groups hold the same motions, up to how well their lines are known."""
    return all(any(float((each - one).norm()) < 4.0 * _MAX_SINE for one in other) for each in group)


def _center(points: Float64[Tensor, "flips 3"], flips: Float64[Tensor, "flips 3 3"]) -> Float64[Tensor, " 3"]:
    """Return the point nearest to all planes and axes, which meet where an object is bounded, from a point of each."""
    # What leads away from a plane or axis, its flip turns round.
    across = (_ONE - flips) / 2.0
    side = (across @ points[..., None]).flatten()
    # The least change to the mean of their points: along what none of them fixes, it stays there.
    middle, matrix = points.mean(0), across.flatten(0, 1)
    return middle + torch.linalg.pinv(matrix, rtol=_MAX_SINE) @ (side - matrix @ middle)
