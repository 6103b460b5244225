"""Which points of an object a camera sees: what lies no deeper than the surface that the camera sees there.

The four pixels around a point's place each say whether their depth reaches the point, within a tolerance, and its
share is their mean, weighted as bilinear interpolation would. Depths themselves are not interpolated: the mean of an
object's depth and of what lies behind it is that of no surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from avmsf.gaussians.cloud import GaussianCloud, rotation_matrices
from avmsf.gaussians.rasterizer.rasterizers import Rasterizer
from avmsf.photographs.cameras import Camera, View

_MIN_COVERAGE = 0.5
"""Share of a pixel that the object must cover for the pixel to show its depth."""

DepthMap = Callable[[Camera], Float[Tensor, "height width"]]
"""What gives the depth of the first surface that each pixel of a camera sees, meters along the axis; 0 where none."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """What one camera sees of many points."""

    pixels: Float[Tensor, "points 2"]
    """In the image, pixels; meaningless where the share is zero."""
    depth: Float[Tensor, " points"]
    """Meters along the optical axis."""
    share: Float[Tensor, " points"]
    """From 0, hidden or outside the image or its mask, to 1, seen."""
    past: Float[Tensor, " points"]
    """Likewise, of what surrounds a point's place and shows a surface behind the point."""
    in_image: Bool[Tensor, " points"]
    """Whether a point's place lies in the image, hidden or not."""
    camera: Camera

    @property
    def seen(self) -> Bool[Tensor, " points"]:
        """Whether more than half of what surrounds a point's place shows the point."""
        return self.share > 0.5


def depth_test(
    points: Float[Tensor, "points 3"],
    view: View,
    depth: Float[Tensor, "height width"],
    *,
    reach: Float[Tensor, " points"],
) -> Visibility:
    """Return what a view's camera sees of the points, given the depth that it sees at each pixel.

    `reach`, meters, is how far behind the seen surface a point may lie and still be on it. Two pixels' width at the
    point's depth is added to it, since a slanted surface is that much deeper or nearer in the next pixel.
    """
    camera = view.camera
    places, deep = camera.project(points.cpu())
    # Behind the camera there are no places, and NaN is not at least 0.
    inside = (places >= 0).all(1) & (places <= places.new_tensor([camera.width, camera.height])).all(1)
    places = torch.where(inside[:, None], places, 0.5)
    tolerance = reach.cpu().double() + 2 * deep / min(camera.focal)
    surface, coverage = depth.detach().double().cpu(), view.coverage
    share, past = torch.zeros_like(deep), torch.zeros_like(deep)
    for rows, columns, weight in _corners(places, camera):
        there = surface[rows, columns]
        shows = (there > 0) & (there >= deep - tolerance)
        if coverage is not None:
            shows &= coverage[rows, columns] >= _MIN_COVERAGE
        share += weight * shows
        past += weight * (shows & (there > deep + tolerance))
    return Visibility(places, deep, torch.where(inside, share, 0.0), torch.where(inside, past, 0.0), inside, camera)


def depth_of_cloud(cloud: GaussianCloud, rasterizer: Rasterizer) -> DepthMap:
    """Return what renders the depth of Gaussians, 0 where they cover less than half of a pixel."""

    def render(camera: Camera) -> Float[Tensor, "height width"]:
        with torch.no_grad():
            rendering = rasterizer(cloud, camera, background=cloud.centers.new_zeros(3))
            return torch.where(rendering.alpha >= _MIN_COVERAGE, rendering.depth, 0.0)

    return render


def depth_reach(cloud: GaussianCloud, camera: Camera) -> Float[Tensor, " points"]:
    """Return each Gaussian's standard deviation along a camera's optical axis, meters."""
    axis = camera.world_to_camera[2, :3].to(cloud.centers)
    # The axis in each Gaussian's own frame: the rotation matrix's columns times it.
    own = (rotation_matrices(cloud.rotations) * axis[:, None]).sum(1)
    return (own * cloud.log_scales.exp()).norm(dim=1)


def _corners(
    places: Float[Tensor, "points 2"], camera: Camera
) -> list[tuple[Int[Tensor, " points"], Int[Tensor, " points"], Float[Tensor, " points"]]]:
    """Return the rows, columns and weights of the four pixels whose centers surround each place."""
    x, y = places[:, 0] - 0.5, places[:, 1] - 0.5
    left, top = x.floor(), y.floor()
    corners = []
    for right in (0, 1):
        for below in (0, 1):
            weight = (1 - (x - left - right).abs()) * (1 - (y - top - below).abs())
            rows = (top + below).long().clamp(0, camera.height - 1)
            columns = (left + right).long().clamp(0, camera.width - 1)
            corners.append((rows, columns, weight))
    return corners
