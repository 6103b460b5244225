"""The symmetry family: a mode's shape belongs to a symmetry of the object's geometry, with a sign that it keeps.

Where a body is symmetric, each mode shape either keeps or changes its sign under a mirror or a half turn g, and gains
at one side follow from those at the other. With k the kernel of another family, which does not change when both impacts
are moved, the covariance of functions of either kind is (k(x, x') +- k(x, g x')) / 2, where g moves the place and turns
the direction. Over a group of motions it is

    K_chi(x, x') = sum_g chi(g) k(x, g x') / |G|,

one for each real character chi (Serre, Linear Representations of Finite Groups, 1977, section 2.6). Groups are those of
each mirror, of each turn, and of each two mirrors or half turns that commute. Which sign a mode has is left to the
evidence. No object is exactly symmetric: a share p of k itself is added, (1 - p) K_chi + p k.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float64, Int
from scipy.linalg import block_diag
from torch import Tensor

from avmsf.field.gains.family import KernelFamily, Sites
from avmsf.field.gains.positional import ThinPlate
from avmsf.scene.symmetry import MirrorSymmetry, RotationalSymmetry, Symmetries

REMAINDERS = (0.1, 0.3)
"""Shares p of what is not symmetric."""
TURNS = 12
"""Order that stands for a turn by any angle: waves up to half as many around the axis are told apart."""
HOLES = 0.05
"""Part of the surface that may have its counterpart in a hole, for a symmetry to count. Of the 20 simulated objects and
two captures true ones have at most .02, those that a thin or open shape only seems to have from .12 on."""
_ALIKE = math.sin(math.radians(7.5))
"""Sine of the angle up to which lines are parallel or perpendicular: axes of groups up to order 12 are 15 degrees
apart, so that no other lies nearer."""
_LEAST = 0.01
"""Least part of the variance at the contacts that a character must have: where all contacts lie on a mirror plane
nothing is known of functions that are odd."""


@dataclass(frozen=True, eq=False)
class Group:
    """Motions that carry an object onto itself, and the characters of the group that they form."""

    motions: Float64[Tensor, "order 3 4"]
    """A point x goes to A x + b, [A b] being the motion, A orthogonal, b in metres. The first one is the identity."""
    characters: Float64[Tensor, "characters order"]
    """Of each motion. The first is one everywhere."""

    def images(self, sites: Sites, *, directional: bool) -> Iterator[Sites]:
        """Yield the impacts as each motion leaves them; it turns their directions only where these are known."""
        for motion in self.motions:
            linear = motion[:, :3].T
            directions = sites.directions @ linear if directional else sites.directions
            yield Sites(sites.points @ linear + motion[:, 3], directions)


class Symmetric(KernelFamily):
    """Thin plates, projected on the characters of the object's symmetries.

    Their affine parts are those of all images of the contacts, so that motions do not change the kernels.
    """

    kind: ClassVar[str] = "symmetry"

    def __init__(self, reference: Sites, size: float, groups: Sequence[Group], *, directional: bool) -> None:
        """Set up; `directional` says whether directions of impacts are known."""
        super().__init__(reference, size)
        self.groups, self._directional = tuple(groups), directional
        self._bases = [ThinPlate(self._orbit(group), size) for group in groups]
        kernels = len(self._bases[0].shares)
        one = torch.eye(kernels, dtype=torch.float64)
        symmetric = _blocks([torch.kron(_shares(group.characters), one) for group in groups])
        whole = _blocks([torch.kron(_identity(group.characters), one) for group in groups])
        own = self.diagonal(reference).mean(1)
        seen = symmetric @ own > _LEAST * (whole @ own)
        symmetric, whole = (each[seen] / (each[seen] @ own)[:, None] for each in (symmetric, whole))
        self.shares = torch.cat([(1.0 - share) * symmetric + share * whole for share in REMAINDERS])
        group_of = torch.cat([torch.full((len(each.characters),), row) for row, each in enumerate(groups)])
        category = (group_of[:, None] * kernels + torch.arange(kernels)).flatten()[seen]
        known = torch.unique(category, return_inverse=True)[1]
        count = int(known.max()) + 1
        self._category = torch.cat([known + step * count for step in range(len(REMAINDERS))])

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the kernels between the impacts and each image of the others, group by group."""
        return torch.cat(list(self._moved(sites, others)))

    def diagonal(self, sites: Sites) -> Float64[Tensor, "basis sites"]:
        """Return the kernels between each impact and its own images."""
        each = [self.basis(sites.take(row), sites.take(row))[:, 0] for row in torch.split(torch.arange(len(sites)), 1)]
        return torch.cat(each, dim=1)

    def categories(self) -> Int[Tensor, " kernels"]:
        """Return one category for each group, kernel and remainder: each mode has a character of its own."""
        return self._category

    def log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "kernels modes"]:
        """Return the log probability of each character in its group: all are equally probable."""
        count = torch.bincount(self._category)[self._category].double()
        return -count.log()[:, None].expand(-1, len(log_frequency))

    def mean(
        self, sites: Sites, known: Sites, coefficients: Float64[Tensor, "basis contacts series"]
    ) -> Float64[Tensor, "sites series"]:
        """Return the family's part of the means, motion by motion: all images at once would take much memory."""
        found, row = torch.zeros(len(sites), coefficients.shape[2], dtype=torch.float64), 0
        for moved in self._moved(sites, known):
            found += torch.einsum("bpc,bcs->ps", moved, coefficients[row : row + len(moved)])
            row += len(moved)
        return found

    def _moved(self, sites: Sites, others: Sites) -> Iterator[Float64[Tensor, "kernels sites others"]]:
        for group, base in zip(self.groups, self._bases, strict=True):
            for image in group.images(others, directional=self._directional):
                yield base.between(sites, image, torch.arange(len(base.shares)))

    def _orbit(self, group: Group) -> Sites:
        images = list(group.images(self.reference, directional=self._directional))
        return Sites(torch.cat([each.points for each in images]), torch.cat([each.directions for each in images]))


def groups_of(symmetries: Symmetries) -> tuple[Group, ...]:
    """Return the groups that an object's symmetries form; none where it has none beyond doubt."""
    mirrors = [each for each in symmetries.mirrors if each.missing <= HOLES]
    turns = [each for each in symmetries.rotations if each.missing <= HOLES]
    if not (mirrors or turns):
        return ()
    center = _center([*mirrors, *turns])
    flips = [(each.normal.double(), -1.0) for each in mirrors]
    found = [([_flip(line, sign)], _SIGNS) for line, sign in flips]
    for turn in turns:
        order = TURNS if turn.order is None else turn.order
        found.append((_turns(turn.axis.double(), order), _cyclic(order)))
        if order % 2 == 0:
            flips.append((turn.axis.double(), 1.0))
    found += [(each, torch.kron(_SIGNS, _SIGNS)) for each in _pairs(flips)]
    one = torch.eye(3, dtype=torch.float64)
    groups = []
    for moved, characters in found:
        linear = torch.stack([one, *moved])
        groups.append(Group(torch.cat([linear, (center - linear @ center)[..., None]], dim=2), characters))
    return tuple(groups)


_SIGNS = torch.tensor([[1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
"""The characters of a group of two."""


def _blocks(each: Sequence[Float64[Tensor, "_rows _columns"]]) -> Float64[Tensor, "rows columns"]:
    return torch.from_numpy(block_diag(*(block.numpy() for block in each)))


def _shares(characters: Float64[Tensor, "characters order"]) -> Float64[Tensor, "characters order"]:
    return characters / characters.shape[1]


def _identity(characters: Float64[Tensor, "characters order"]) -> Float64[Tensor, "characters order"]:
    return torch.eye(1, characters.shape[1], dtype=torch.float64).expand(len(characters), -1)


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
