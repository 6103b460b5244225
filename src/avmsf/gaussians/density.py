"""Which Gaussians there are: adaptive density control while they are fitted, and the pruning to those of the object.

While they are fitted (3DGS, section 5.2) one whose position gradient in the image is large covers too much: a small one
is copied, a large one is split into two smaller ones drawn from its own density. One that is almost transparent, or as
large as the object, is removed. In the end those go that are transparent, too large, hidden, isolated or outside the
masks.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import ZEROTH, GaussianCloud, rotation_matrices
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.rasterizer.rasterizers import Rasterizer, Rendering
from avmsf.photographs.cameras import Camera, View

_SPLIT_RATIO = 1.6
"""How much smaller the halves of a split Gaussian are (3DGS)."""
_MAX_FITTED_SCALE_RATIO = 0.3
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
        kept = (cloud.opacities >= config.least_opacity) & (largest <= _MAX_FITTED_SCALE_RATIO * half_diagonal)
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


_NEIGHBORS = 8
_MAX_DISTANCE_RATIO = 6.0
"""Largest mean distance to the neighbors, in medians of that distance, beyond which a Gaussian is an outlier."""
_MAX_SCALE_RATIO = 0.15
"""Largest scale, in diagonals of the box around the middle 98 % of the centers."""
_MIN_OPACITY = 0.1
_MAX_WRONG_MASKS_RATIO = 0.1
"""Views whose mask leaves a center out, over those that have it in their image."""
_MIN_WEIGHT_PIXELS = 0.5
"""What a Gaussian colors of a view, as a sum over its pixels, in the view where it is the most."""
_MASK_MARGIN_PIXELS = 2
"""Pixels that a center may lie outside of a mask, whose edge is not known better."""


def keep_object(cloud: GaussianCloud, views: Sequence[View], *, rasterizer: Rasterizer | None = None) -> GaussianCloud:
    """Return the Gaussians that lie on the object.

    Those go whose opacity is less than .1; whose center is outside of the masks in more than a tenth of the views that
    have it in their image; whose scale is that of the object; whose neighbors are far away; and, with a `rasterizer`,
    those that in no view color as much as half a pixel in sum, because others hide them. Raises `SceneError` where
    nothing remains.
    """
    tests: list[Callable[[GaussianCloud], Bool[Tensor, " points"]]] = [
        lambda cloud: cloud.opacities >= _MIN_OPACITY,
        lambda cloud: _masks_agree(cloud.centers, views),
        _is_smaller_than_object,
    ]
    if rasterizer is not None:
        tests.append(lambda cloud: blended_weight(cloud, views, rasterizer=rasterizer) >= _MIN_WEIGHT_PIXELS)
    tests.append(_is_near_others)
    kept = cloud.detach()
    for test in tests:
        kept = kept.take(test(kept))
        if not len(kept):
            advice = "check that masks, cameras and Gaussians belong together and that not all are almost transparent"
            got = f"none of {len(cloud)}"
            raise SceneError.expected("some on the object", 0, got=got, name="gaussians", advice=advice)
    return kept


def _masks_agree(points: Float[Tensor, "points 3"], views: Sequence[View]) -> Bool[Tensor, " points"]:
    """Return which points few of the views with them in their image see outside of their mask."""
    device, points = points.device, points.cpu()
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _MASK_MARGIN_PIXELS + 1,) * 2)
    seen, against, voters = torch.zeros(len(points)), torch.zeros(len(points)), 0
    for view in views:
        if view.mask is None or not view.foreground.any():
            continue
        voters += 1
        mask = torch.from_numpy(cv2.dilate(view.mask.numpy(), kernel)) > 127
        places, _ = view.camera.project(points)
        inside = view.camera.contains(places)
        pixels = places[inside].long()
        seen += inside
        against[inside] += (~mask[pixels[:, 1], pixels[:, 0]]).float()
    if not voters:
        return torch.ones(len(points), dtype=torch.bool, device=device)
    return ((seen > 0) & (against <= _MAX_WRONG_MASKS_RATIO * seen)).to(device)


def blended_weight(cloud: GaussianCloud, views: Sequence[View], *, rasterizer: Rasterizer) -> Float[Tensor, " points"]:
    """Return each Gaussian's largest share in an image: its blending weights summed over the pixels of a view.

    Taken from the slope of a rendering by the Gaussians' own brightness, which any rasterizer has.
    """
    largest = torch.zeros_like(cloud.logit_opacities)
    for view in views:
        # Gray is far from black, at which colors are cut off and have no slope.
        gray = torch.zeros_like(cloud.harmonics[:, :1], requires_grad=True)
        plain = replace(cloud.detach(), harmonics=gray)
        color = rasterizer(plain, view.camera, background=largest.new_zeros(3)).color
        (slope,) = torch.autograd.grad(color[..., 0].sum(), gray)
        largest = torch.maximum(largest, slope[:, 0, 0] / ZEROTH)
    return largest


def _is_smaller_than_object(cloud: GaussianCloud) -> Bool[Tensor, " points"]:
    places = cloud.centers
    low, high = torch.quantile(places[:: max(1, len(places) // 100_000)], places.new_tensor([0.01, 0.99]), dim=0)
    return cloud.log_scales.amax(1).exp() <= _MAX_SCALE_RATIO * float((high - low).norm())


def _is_near_others(cloud: GaussianCloud) -> Bool[Tensor, " points"]:
    places = cloud.centers.double().cpu().numpy()
    count = min(_NEIGHBORS, len(places) - 1)
    if count < 1:
        return torch.ones_like(cloud.logit_opacities, dtype=torch.bool)
    distance = cKDTree(places).query(places, k=np.arange(2, count + 2))[0].mean(1)
    return torch.from_numpy(distance <= _MAX_DISTANCE_RATIO * np.median(distance)).to(cloud.centers.device)
