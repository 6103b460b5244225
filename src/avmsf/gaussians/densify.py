"""Adaptive density control (3DGS, section 5.2): Gaussians copied, split and removed while they are fitted.

One whose position gradient in the image is large covers too much: a small one is copied, a large one is split into two
smaller ones drawn from its own density. One that is almost transparent, or as large as the object, is removed.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.gaussians.cloud import GaussianCloud, rotation_matrices
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.rasterizer.protocol import Rendering
from avmsf.photographs.cameras import Camera

_SPLIT_RATIO = 1.6
"""How much smaller the halves of a split Gaussian are (3DGS)."""
_MAX_SCALE_RATIO = 0.3
"""Largest scale, in half diagonals of the object, that a Gaussian may have."""


@dataclass(frozen=True, eq=False)
class Density:
    """The accumulated position gradient of each Gaussian since the number last changed."""

    gradient: Float[Tensor, " points"]
    """Sum over views of the length of the loss's gradient by the center in the image, in half images, as in gsplat."""
    views: Float[Tensor, " points"]
    """Views that saw the Gaussian."""

    @classmethod
    def zeros(cls, cloud: GaussianCloud) -> "Density":
        """Return the sums before the first view."""
        return cls(*cloud.logit_opacities.new_zeros(2, len(cloud)))

    def add_view(self, rendering: Rendering, camera: Camera) -> None:
        """Add one view's gradient, after the backward pass."""
        slope = rendering.screen.grad
        if slope is None:
            return
        self.gradient.add_(torch.hypot(slope[:, 0] * (camera.width / 2), slope[:, 1] * (camera.height / 2)))
        self.views.add_((rendering.radii > 0).float())

    def densify(
        self, cloud: GaussianCloud, config: SplatConfig, half_diagonal: float, *, generator: torch.Generator
    ) -> tuple[Tensor, GaussianCloud]:
        """Return the rows that stay, and the Gaussians that are new: copies, and the two halves of each split one.

        Of more candidates than the config has room for, those with the largest gradient are taken.
        """
        largest = cloud.log_scales.amax(1).exp()
        kept = (cloud.opacities >= config.least_opacity) & (largest <= _MAX_SCALE_RATIO * half_diagonal)
        strength = torch.where(kept, self.gradient / self.views.clamp(min=1.0), 0.0)
        room = max(0, config.gaussians - int(kept.sum()))
        wanted = min(room, int((strength > config.growth).sum()))
        chosen = torch.zeros_like(kept)
        chosen[torch.sort(strength, descending=True, stable=True).indices[:wanted]] = True
        small = largest <= config.large * half_diagonal
        copied, split = cloud.take(chosen & small), cloud.take(chosen & ~small)
        halves = _split(split, generator=generator)
        return torch.nonzero(kept & ~(chosen & ~small))[:, 0], copied.join(halves)


def _split(cloud: GaussianCloud, *, generator: torch.Generator) -> GaussianCloud:
    twice = cloud.take(torch.arange(len(cloud), device=cloud.centers.device).repeat(2))
    offsets = torch.randn(len(twice), 3, generator=generator).to(twice.centers) * twice.log_scales.exp()
    centers = twice.centers + (rotation_matrices(twice.rotations) @ offsets[..., None])[..., 0]
    scales = twice.log_scales - math.log(_SPLIT_RATIO)
    return GaussianCloud(centers, twice.rotations, scales, twice.logit_opacities, twice.harmonics)
