"""Groups of an object's symmetries, and their real characters: the signs that a function may keep under each motion.

Groups are those of each mirror, of each turn, and of each two mirrors or half turns that commute (Serre, Linear
Representations of Finite Groups, 1977, section 2).
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.symmetry.motions import Matrices, Motions, Points, reflections, rotations
from avmsf.symmetry.symmetries import Symmetries

TURNS = 12
"""Order that stands for a turn by any angle: waves up to half as many around the axis are told apart."""
_MAX_SINE = math.sin(math.radians(7.5))
"""Sine of the angle up to which lines are parallel or perpendicular: axes of groups up to order 12 are 15 degrees
apart, so that no other lies nearer."""
_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0]])
"""The characters of a group of two."""


@dataclass(frozen=True, eq=False)
class Group:
    """Motions that carry an object onto itself, and the characters of the group that they form."""

    motions: Float64[Tensor, "order 3 4"]
    """A point x goes to A x + b, [A b] being the motion, A orthogonal, b in meters. The first one is the identity."""
    characters: Float64[Tensor, "characters order"]
    """Of each motion. The first is one everywhere."""


def groups_of(symmetries: Symmetries) -> tuple[Group, ...]:
    """Return the groups that an object's symmetries form; none where it has none beyond doubt."""
    mirrors, turns = symmetries.mirrors, symmetries.rotations
    if not symmetries:
        return ()
    lines = torch.stack([*(each.normal for each in mirrors), *(each.axis for each in turns)]).double().numpy()
    points = torch.stack([*(each.point for each in mirrors), *(each.point for each in turns)]).double().numpy()
    signs = np.repeat([-1.0, 1.0], [len(mirrors), len(turns)])
    # The point nearest to all planes and axes, which meet where an object is bounded.
    middle = points.mean(0)
    center = middle + Motions.about(points - middle, _flips(lines, signs)).center()
    found = [(_flips(lines[row : row + 1], signs[row : row + 1]), _SIGNS) for row in range(len(mirrors))]
    for each in turns:
        angles = each.angles(TURNS)
        order = len(angles)
        # The real characters of a turn's group: waves of each number around the axis.
        waves = np.cos(2.0 * np.pi / order * np.outer(np.arange(order // 2 + 1), np.arange(order)))
        found.append((rotations(each.axis.double().numpy(), angles[1:]), waves))
    flips = [True] * len(mirrors) + [len(each.angles(TURNS)) % 2 == 0 for each in turns]
    found += [(pair, np.kron(_SIGNS, _SIGNS)) for pair in _pairs(lines[flips], signs[flips])]
    groups = []
    for linear, characters in found:
        motions = Motions.about(center, np.concatenate([np.eye(3)[None], linear]))
        matrices = torch.from_numpy(np.concatenate([motions.linear, motions.shifts[..., None]], axis=2))
        groups.append(Group(matrices, torch.from_numpy(characters)))
    return tuple(groups)


def _flips(lines: Points, signs: Float[np.ndarray, " points"]) -> Matrices:
    """Return the half turn about each line (sign 1), or the reflection along it (sign -1)."""
    return -signs[:, None, None] * reflections(lines)


def _pairs(lines: Points, signs: Float[np.ndarray, " points"]) -> list[Matrices]:
    """Return what every two flips that commute form with their product, each group once.

    Lines that were found are off by a degree or so. Their nearest perpendicular or common ones are taken, so that the
    flips commute exactly.
    """
    found: list[Matrices] = []
    for pair in itertools.combinations(range(len(lines)), 2):
        one, other = lines[list(pair)]
        cosine = float(one @ other)
        if abs(cosine) <= _MAX_SINE:
            left, _, right = np.linalg.svd(np.stack([one, other]), full_matrices=False)
            exact = left @ right
        elif 1.0 - cosine**2 <= _MAX_SINE**2:
            common = one + math.copysign(1.0, cosine) * other
            exact = np.tile(common / np.linalg.norm(common), (2, 1))
        else:
            continue
        first, second = _flips(exact, signs[list(pair)])
        group = np.stack([second, first, first @ second])
        if not any(_same(group, known) for known in found):
            found.append(group)
    return found


def _same(group: Matrices, other: Float[np.ndarray, "others 3 3"]) -> bool:
    """Return whether two groups hold the same motions, up to how well their lines are known."""
    return all((np.linalg.norm(each - other, axis=(1, 2)) < 4.0 * _MAX_SINE).any() for each in group)
