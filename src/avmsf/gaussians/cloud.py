"""An object as 3D Gaussians: soft ellipsoids with an opacity and a color that depends on the direction of view."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avmsf._utils.arrays import short_repr

ZEROTH = 0.28209479177387814
"""The harmonic of degree 0, sqrt(1 / 4 pi): a color is one half more than this times its coefficient."""


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """The Gaussians of one object, in the object frame (Kerbl et al. 2023, "3D Gaussian Splatting")."""

    __repr__ = short_repr

    centers: Float[Tensor, "points 3"]
    """Meters."""
    rotations: Float[Tensor, "points 4"]
    """Quaternions w, x, y, z from each Gaussian's own axes to the object frame; normalized where they are used."""
    log_scales: Float[Tensor, "points 3"]
    """Natural logarithms of the standard deviations along the own axes, meters."""
    logit_opacities: Float[Tensor, " points"]
    """Opacity at the center is the sigmoid of these."""
    harmonics: Float[Tensor, "points coefficients 3"]
    """Spherical harmonics of red, green and blue: 1, 4, 9 or 16 coefficients, degree 0 to 3, in the order of 3DGS."""

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def opacities(self) -> Float[Tensor, " points"]:
        """Opacity at each center, 0 to 1."""
        return torch.sigmoid(self.logit_opacities)

    @property
    def colors(self) -> Float[Tensor, "points 3"]:
        """Red, green and blue independent of the direction of view, 0 to 1."""
        return (0.5 + ZEROTH * self.harmonics[:, 0]).clamp(0.0, 1.0)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return int(self.harmonics.shape[1] ** 0.5) - 1

    def take(self, chosen: Int[Tensor, " chosen"] | Bool[Tensor, " points"]) -> "GaussianCloud":
        """Return the Gaussians of the given rows."""
        return self._each(lambda values: values[chosen])

    def to(self, device: torch.device | str) -> "GaussianCloud":
        """Return the same Gaussians with their tensors on `device`."""
        return self._each(lambda values: values.to(device))

    def detach(self) -> "GaussianCloud":
        """Return the same Gaussians, through which no derivative passes."""
        return self._each(Tensor.detach)

    def join(self, other: "GaussianCloud") -> "GaussianCloud":
        """Return these Gaussians and then those of another cloud with harmonics of the same degree."""
        return GaussianCloud(*map(torch.cat, zip(vars(self).values(), vars(other).values(), strict=True)))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "GaussianCloud":
        return GaussianCloud(*map(change, vars(self).values()))


def rotation_matrices(quaternions: Float[Tensor, "points 4"]) -> Float[Tensor, "points 3 3"]:
    """Return the rotations of quaternions w, x, y, z of any length but zero."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
