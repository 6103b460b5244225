"""The shape of what Gaussians show, and pictures of them."""

from collections.abc import Sequence

import torch

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.rasterizer.protocol import Rasterizer
from avmsf.gaussians.rasterizer.rasterizers import choose_rasterizer
from avmsf.gaussians.visibility import depth_of_cloud
from avmsf.mesh.surface import Surface
from avmsf.photographs.cameras import View
from avmsf.photographs.mesh_views import orbit_cameras
from avmsf.reconstruction import ObjectShape, object_surface

_MIN_COUNT = 100
"""Gaussians; what encloses an object is not known from fewer."""
_MIN_OPACITY = 0.05
"""Opacity below which a Gaussian does not show where the object is."""
_MIN_MASKS = 3
"""Masks from which outlines are taken; with fewer, pictures of the Gaussians have them."""
_SIZE = 256
"""Width and height of such pictures, pixels."""


def shape_of_cloud(cloud: GaussianCloud, views: Sequence[View] = (), *, cells: int = 128) -> ObjectShape:
    """Return the shape of the object that Gaussians show; masks of views say where its outlines are.

    Where fewer than 3 views have masks, pictures of the Gaussians from all sides stand for them. Raises SceneError for
    fewer than 100 Gaussians that can be seen, for Gaussians in one place, and as `object_surface` does.
    """
    cloud = _visible(cloud)
    rasterizer = choose_rasterizer(cloud.centers.device)
    if not masks_suffice(views):
        views = views_of_cloud(cloud, rasterizer, size=_SIZE)
    return object_surface(views, depth_of_cloud(cloud, rasterizer), cells=cells)


def masks_suffice(views: Sequence[View]) -> bool:
    """Return whether 3 or more views have masks that show something."""
    return sum(bool(view.foreground.any()) for view in views) >= _MIN_MASKS


def views_of_cloud(cloud: GaussianCloud, rasterizer: Rasterizer, *, size: int) -> tuple[View, ...]:
    """Return the 72 pictures of `orbit_cameras` of Gaussians before white, `size` pixels wide, with masks."""
    box = Surface(cloud.centers.float(), torch.zeros(0, 3, dtype=torch.int64))
    views = []
    for number, camera in enumerate(orbit_cameras(box, size=size)):
        with torch.no_grad():
            seen = rasterizer(cloud, camera, background=cloud.centers.new_ones(3))
        image, mask = ((255 * each.clamp(0, 1)).round().to(torch.uint8) for each in (seen.color, seen.alpha))
        views.append(View(f"view_{number:03d}", image, camera, mask))
    return tuple(views)


def _visible(cloud: GaussianCloud) -> GaussianCloud:
    """Return the Gaussians of enough opacity to be seen. Raises SceneError where they cannot be an object."""
    visible = cloud.detach().take(cloud.opacities.detach() >= _MIN_OPACITY)
    advice = "fit the Gaussians again, with more steps or better masks"
    if len(visible) < _MIN_COUNT:
        wanted = f"{_MIN_COUNT} Gaussians or more of at least {_MIN_OPACITY}"
        raise SceneError.expected(wanted, len(visible), name="opacities", advice=advice)
    if not float((visible.centers.amax(0) - visible.centers.amin(0)).max()) > 0:
        center = visible.centers[0].tolist()
        raise SceneError.expected("Gaussians all over an object", center, name="centers", advice=advice)
    return visible
