"""From Gaussians in space to ellipses in the image: the first half of rasterizing, with its gradient.

The conventions are gsplat's. `ellipses` and `harmonics` hold the kernels.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from avmsf._utils.compiled import lane_count, run_lanes
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.ellipses import project_points, project_points_back
from avmsf.gaussians.rasterizer.harmonics import shade, shade_back
from avmsf.photographs.cameras import Camera

_SLOPE_MARGIN = 0.3
"""The Jacobian of the perspective projection is taken no further off axis than the image's edge and this part of half
its width (3DGS)."""


class Projection(torch.autograd.Function):
    """Places, shapes, opacities, colors and depths of a cloud's Gaussians in one image, and their reach."""

    @staticmethod
    def forward(
        ctx: Any,
        centers: Float32[Tensor, "points 3"],
        rotations: Float32[Tensor, "points 4"],
        log_scales: Float32[Tensor, "points 3"],
        logit_opacities: Float32[Tensor, " points"],
        weights: Float32[Tensor, "points coefficients 3"],
        camera: Camera,
    ) -> tuple[Tensor, ...]:
        """Return screen [points, 2], ellipses [points, 3], opacities, colors [points, 3], depths, radii, remainders.

        An ellipse holds p, r and s of the triangular matrix that takes an offset (x, y) in pixels to standard
        deviations: (p x + r y, s y). Unseen Gaussians have radius 0, bad ones radius NaN. The remainders [points, 2]
        are what float32 rounds off the screen places.
        """
        inputs = [each.detach().contiguous() for each in (centers, rotations, log_scales, logit_opacities, weights)]
        lens, pose = _lens(camera), np.ascontiguousarray(camera.world_to_camera[:3].double().numpy())
        count = len(centers)
        outputs = [inputs[0].new_zeros(count, width) for width in (2, 3, 1, 3, 1, 1, 2)]
        screen, ellipses, opacities, colors, depths, radii, remainders = outputs
        results = tuple(each.numpy() for each in (screen, ellipses, opacities, depths, radii, remainders))
        given, lanes = tuple(each.numpy() for each in inputs), lane_count()
        position = camera.position.double().numpy()
        run_lanes(project_points, lanes, given, pose, lens, np.empty((lanes, 16, 3)), results)
        run_lanes(shade, lanes, given[0], given[4], radii.numpy(), position, np.empty((lanes, 35)), colors.numpy())
        ctx.save_for_backward(*inputs, radii)
        ctx.pose, ctx.lens, ctx.position = pose, lens, position
        ctx.mark_non_differentiable(radii, remainders)
        return screen, ellipses, opacities, colors, depths, radii, remainders

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        """Return the loss's derivatives by the five tensors; the camera has none."""
        *inputs, radii = ctx.saved_tensors
        centers, rotations, log_scales, logits, weights, reach = (each.numpy() for each in (*inputs, radii))
        by_screen, by_ellipses, by_opacities, by_colors, by_depths = (each.contiguous().numpy() for each in slopes[:5])
        outputs = [torch.zeros_like(each) for each in inputs]
        *results, by_weights = (each.numpy() for each in outputs)
        given, by_places = (centers, rotations, log_scales, logits), (by_screen, by_ellipses, by_opacities, by_depths)
        lanes = lane_count()
        working = ctx.pose, ctx.lens, np.empty((lanes, 16, 3))
        run_lanes(project_points_back, lanes, given, reach, by_places, *working, tuple(results))
        shaded = centers, weights, reach, ctx.position, by_colors, np.empty((lanes, 35))
        run_lanes(shade_back, lanes, *shaded, results[0], by_weights)
        return *outputs, None


def project(cloud: GaussianCloud, camera: Camera) -> tuple[Tensor, ...]:
    """Return what `Projection.forward` does for a cloud, differentiable."""
    result: tuple[Tensor, ...] = Projection.apply(  # type: ignore[no-untyped-call]
        cloud.centers, cloud.rotations, cloud.log_scales, cloud.logit_opacities, cloud.harmonics, camera
    )
    return result


def _lens(camera: Camera) -> Float64[np.ndarray, "10"]:
    """Return focal lengths, principal point, size, and the tangents left, right, up and down up to which J is taken."""
    (across, down), (middle, center) = camera.focal, camera.principal
    sides, ends = _SLOPE_MARGIN * 0.5 * camera.width / across, _SLOPE_MARGIN * 0.5 * camera.height / down
    left, right = -middle / across - sides, (camera.width - middle) / across + sides
    top, bottom = -center / down - ends, (camera.height - center) / down + ends
    return np.array([across, down, middle, center, camera.width, camera.height, left, right, top, bottom])
