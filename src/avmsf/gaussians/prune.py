"""Pruning: the Gaussians of the object, without those transparent, too large, hidden, isolated or outside the masks."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import ZEROTH, GaussianCloud
from avmsf.gaussians.rasterizer.protocol import Rasterizer
from avmsf.photographs.cameras import View

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
