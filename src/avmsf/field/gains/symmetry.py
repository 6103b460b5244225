"""The symmetry family: a mode's shape belongs to a symmetry of the object's geometry, with a sign that it keeps.

Where a body is symmetric, each mode shape either keeps or changes its sign under a mirror or a half turn g, and gains
at one side follow from those at the other. With k the kernel of another family, which does not change when both impacts
are moved, the covariance of functions of either kind is (k(x, x') +- k(x, g x')) / 2, where g moves the place and turns
the direction. Over a group of motions it is

    K_chi(x, x') = sum_g chi(g) k(x, g x') / |G|,

one for each real character chi (`avmsf.symmetry.characters`). Which sign a mode has is left to the evidence. No
object is exactly symmetric: a share p of k itself is added, (1 - p) K_chi + p k.
"""

from collections.abc import Iterator, Sequence
from typing import ClassVar

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.field.gains.kernels import KernelFamily, Sites, ThinPlate
from avmsf.symmetry.characters import Group

RESIDUALS = (0.1, 0.3)
"""Shares p of what is not symmetric."""
_MIN_PART = 0.01
"""Least part of the variance at the contacts that a character must have: where all contacts lie on a mirror plane
nothing is known of functions that are odd."""


class Symmetric(KernelFamily):
    """Thin plates, projected on the characters of the object's symmetries.

    Their affine parts are those of all images of the contacts, so that motions do not change the kernels.
    """

    kind: ClassVar[str] = "symmetry"

    def __init__(self, reference: Sites, size: float, groups: Sequence[Group], *, directional: bool) -> None:
        """Set up; `directional` says whether directions of impacts are known."""
        super().__init__(reference, size)
        self.groups, self._directional = tuple(groups), directional
        self._bases = [ThinPlate(Sites.joined(list(self._images(group, reference))), size) for group in groups]
        kernels = len(self._bases[0])
        one = torch.eye(kernels, dtype=torch.float64)
        characters = [group.characters for group in groups]
        shares = [each / each.shape[1] for each in characters]
        identity = [torch.eye(1, each.shape[1], dtype=torch.float64).expand(len(each), -1) for each in characters]
        symmetric, whole = (
            torch.block_diag(*(torch.kron(each, one) for each in parts))  # type: ignore[no-untyped-call]
            for parts in (shares, identity)
        )
        own = self.diagonal(reference).mean(1)
        seen = symmetric @ own > _MIN_PART * (whole @ own)
        symmetric, whole = (each[seen] / (each[seen] @ own)[:, None] for each in (symmetric, whole))
        self.shares = torch.cat([(1.0 - share) * symmetric + share * whole for share in RESIDUALS])
        group_of = torch.repeat_interleave(torch.tensor([len(each) for each in characters]))
        category = (group_of[:, None] * kernels + torch.arange(kernels)).flatten()[seen]
        known = torch.unique(category, return_inverse=True)[1]
        count = int(known.max()) + 1
        self._category = torch.cat([known + step * count for step in range(len(RESIDUALS))])

    def basis(self, sites: Sites, others: Sites) -> Float64[Tensor, "basis sites others"]:
        """Return the kernels between the impacts and each image of the others, group by group."""
        pairs = zip(self.groups, self._bases, strict=True)
        images = ((base, each) for group, base in pairs for each in self._images(group, others))
        return torch.cat([base.between(sites, image) for base, image in images])

    def categories(self) -> Int[Tensor, " kernels"]:
        """Return one category for each group, kernel and remainder: each mode has a character of its own."""
        return self._category

    def log_prior(self, log_frequency: Float64[Tensor, " modes"]) -> Float64[Tensor, "kernels modes"]:
        """Return the log probability of each character in its group: all are equally probable."""
        count = torch.bincount(self._category)[self._category].double()
        return -count.log()[:, None].expand(-1, len(log_frequency))

    def _images(self, group: Group, sites: Sites) -> Iterator[Sites]:
        """Yield the impacts as each motion leaves them; it turns their directions only where these are known."""
        for motion in group.motions:
            linear = motion[:, :3].T
            directions = sites.directions @ linear if self._directional else sites.directions
            yield Sites(sites.points @ linear + motion[:, 3], directions)
