"""The symmetry family: a mode's shape belongs to a symmetry of the object's geometry, with a sign that it keeps.

Where a body is symmetric, each mode shape either keeps or changes its sign under a mirror or a half turn g, and gains
at one side follow from those at the other. With k a smooth kernel between impacts, the covariance of functions of
either kind is (k(x, x') +- k(x, g x')) / 2, where g moves the place and turns the direction. Over a group it is

    K_chi(x, x') = sum_g chi(g) k(x, g x') / |G|,

one for each real character chi (Serre, Linear Representations of Finite Groups, 1977, section 2.6): it is positive
semidefinite as k does not change when both impacts are moved. Groups are those of each mirror, of each turn, and of
each two mirrors or half turns that commute. Which sign a mode has is left to the evidence.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.field.gains.family import KernelFamily, Sites, scaled, squared_exponential
from avmsf.scene.symmetry import MirrorSymmetry, RotationalSymmetry, Symmetries

LENGTHS = (0.1, 0.2, 0.4)
"""Lengths of the smooth kernels over the object's size."""
TURNS = 12
"""Order that stands for a turn by any angle: waves up to half as many around the axis are told apart."""
HOLES = 0.05
"""Part of the surface that may have its counterpart in a hole, for a symmetry to count. Of the 20 simulated objects and
two captures true ones have at most .02, those that a thin or open shape only seems to have from .12 on."""
_ALIKE = math.sin(math.radians(7.5))
"""Sine of the angle up to which lines are parallel or perpendicular: axes of groups up to order 12 are 15 degrees
apart, so that no other lies nearer."""


@dataclass(frozen=True, eq=False)
class Characters:
    """Motions that carry an object onto itself, and characters of the groups that they form."""

    motions: Float64[Tensor, "motions 3 4"]
    """A point x goes to A x + b, [A b] being the motion, A orthogonal, b in metres. The first one is the identity."""
    values: Float64[Tensor, "characters motions"]
    """Of each motion in each character; zero for motions of other groups."""

    @classmethod
    def of(cls, symmetries: Symmetries) -> "Characters":
        """Return the characters of the groups of an object's symmetries; none where it has none beyond doubt."""
        mirrors = [each for each in symmetries.mirrors if each.missing <= HOLES]
        turns = [each for each in symmetries.rotations if each.missing <= HOLES]
        center = _center([*mirrors, *turns])
        groups: list[tuple[list[Tensor], Tensor]] = []
        flips = [(each.normal.double(), -1.0) for each in mirrors]
        groups += [([_flip(line, sign)], _SIGNS) for line, sign in flips]
        for turn in turns:
            order = TURNS if turn.order is None else turn.order
            groups.append((_turns(turn.axis.double(), order), _cyclic(order)))
            if order % 2 == 0:
                flips.append((turn.axis.double(), 1.0))
        groups += [(each, torch.kron(_SIGNS, _SIGNS)) for each in _pairs(flips)]
        linear = [torch.eye(3, dtype=torch.float64), *itertools.chain(*(each for each, _ in groups))]
        values = torch.zeros(sum(len(each) for _, each in groups), len(linear), dtype=torch.float64)
        row, column = 0, 1
        for turned, signs in groups:
            rows = slice(row, row + len(signs))
            values[rows, 0] = signs[:, 0]
            values[rows, column : column + len(turned)] = signs[:, 1:]
            row, column = row + len(signs), column + len(turned)
        parts = torch.stack(linear)
        return cls(torch.cat([parts, (center - parts @ center)[..., None]], dim=2), values)


class Symmetric(KernelFamily):
    """Squared exponential kernels of several lengths, projected on the characters of the object's symmetries."""

    kind: ClassVar[str] = "symmetry"

    def __init__(self, reference: Sites, size: float, characters: Characters, *, directional: bool) -> None:
        """Set up; `directional` says whether directions of impacts are known, which motions then turn."""
        super().__init__(reference, size)
        self.characters, self._directional = characters, directional
        self._lengths = size * torch.tensor(LENGTHS, dtype=torch.float64)
        alone = torch.eye(len(LENGTHS), dtype=torch.float64)
        self.shares = scaled(torch.kron(characters.values, alone), self.diagonal(reference))

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the kernels between the impacts and the images of the others, motion by motion."""
        return torch.cat([self._moved(sites, others, motion) for motion in self.characters.motions])

    def diagonal(self, sites: Sites) -> Float64[Tensor, "basis sites"]:
        """Return the kernels between each impact and its own images."""
        found = []
        for motion in self.characters.motions:
            image = self._image(sites, motion)
            square = (sites.points - image.points).square().sum(1)
            cosine = (sites.directions * image.directions).sum(1)
            found.append(torch.exp(-0.5 * square / self._lengths[:, None].square()) * cosine)
        return torch.cat(found)

    def categories(self) -> Int[Tensor, " kernels"]:
        """Return one category for each group and length: each mode has a character of its own."""
        # The first character of a group is one everywhere; the others sum to zero over it.
        group = (self.characters.values >= 0).all(1).cumsum(0) - 1
        return (group[:, None] * len(LENGTHS) + torch.arange(len(LENGTHS))).flatten()

    def log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "kernels modes"]:
        """Return the log probability of each character in its group: all are equally probable."""
        category = self.categories()
        return -torch.bincount(category)[category].double().log()[:, None].expand(-1, len(log_frequency))

    def mean(
        self, sites: Sites, known: Sites, coefficients: Float64[Tensor, "basis contacts series"]
    ) -> Float64[Tensor, "sites series"]:
        """Return the family's part of the means, motion by motion: all images at once would take much memory."""
        parts = zip(self.characters.motions, coefficients.split(len(LENGTHS)), strict=True)
        found = torch.zeros(len(sites), coefficients.shape[2], dtype=torch.float64)
        for motion, part in parts:
            found += torch.einsum("lpc,lcs->ps", self._moved(sites, known, motion), part)
        return found

    def _moved(
        self, sites: Sites, others: Sites, motion: Float64[Tensor, "3 4"]
    ) -> Float64[Tensor, "lengths sites others"]:
        image = self._image(others, motion)
        return squared_exponential(sites.points, image.points, self._lengths) * sites.cosine(image)

    def _image(self, sites: Sites, motion: Float64[Tensor, "3 4"]) -> Sites:
        linear = motion[:, :3].T
        directions = sites.directions @ linear if self._directional else sites.directions
        return Sites(sites.points @ linear + motion[:, 3], directions)


_SIGNS = torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
"""The characters of a group of two."""


def _flip(line: Float64[Tensor, " 3"], sign: float) -> Float64[Tensor, "3 3"]:
    """Return the half turn about a line (sign 1), or the mirror whose normal it is (sign -1)."""
    return sign * (2.0 * torch.outer(line, line) - torch.eye(3, dtype=torch.float64))


def _turns(axis: Float64[Tensor, " 3"], order: int) -> list[Float64[Tensor, "3 3"]]:
    """Return all turns of an axis but the identity."""
    cross = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    angles = [2.0 * math.pi * step / order for step in range(1, order)]
    one = torch.eye(3, dtype=torch.float64)
    return [one + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross for angle in angles]


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
        if abs(cosine) <= _ALIKE:
            left, _, right = torch.linalg.svd(torch.stack([line, other]), full_matrices=False)
            one, two = left @ right
        elif 1.0 - cosine**2 <= _ALIKE**2:
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
    return all(any(float((each - one).norm()) < 4.0 * _ALIKE for one in other) for each in group)


def _center(symmetries: Sequence[MirrorSymmetry | RotationalSymmetry]) -> Float64[Tensor, " 3"]:
    """Return the point nearest to all planes and axes, which meet where an object is bounded."""
    if not symmetries:
        return torch.zeros(3, dtype=torch.float64)
    points = torch.stack([each.point.double() for each in symmetries])
    across = torch.stack([_across(each) for each in symmetries])
    side = (across @ points[..., None]).flatten()
    # The least change to the mean of their points: along what none of them fixes, it stays there.
    middle, matrix = points.mean(0), across.flatten(0, 1)
    return middle + torch.linalg.pinv(matrix, rtol=_ALIKE) @ (side - matrix @ middle)


def _across(symmetry: MirrorSymmetry | RotationalSymmetry) -> Float64[Tensor, "3 3"]:
    """Return the projection of an offset from the symmetry's point on what leads away from its plane or axis."""
    line = symmetry.normal if isinstance(symmetry, MirrorSymmetry) else symmetry.axis
    along = torch.outer(line.double(), line.double())
    return along if isinstance(symmetry, MirrorSymmetry) else torch.eye(3, dtype=torch.float64) - along
