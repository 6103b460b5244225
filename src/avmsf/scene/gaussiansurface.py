"""From Gaussians to the closed surface of their object: whatever cameras see to be free is carved away.

Gaussians need no normals for this, and a wall seen from both sides keeps its thickness. What no camera sees stays: the
inside of a narrow vessel comes out filled, as far as nobody looked into it.
"""

from collections.abc import Sequence
from dataclasses import fields
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy import ndimage

from avmsf.capture.cameras import Camera
from avmsf.capture.levelset import enclose
from avmsf.capture.meshviews import orbit_cameras
from avmsf.capture.surface import Surface
from avmsf.compiled import compiled, lane_count, run_lanes
from avmsf.errors import CaptureError, SceneError
from avmsf.scene.gaussians import GaussianCloud
from avmsf.scene.rasteriser import Rasteriser, choose_rasteriser
from avmsf.scene.visibility import DepthMap, depth_of_cloud

_FEWEST = 100
"""Gaussians; what encloses an object is not known from fewer."""
_FAINT = 0.05
"""Opacity below which a Gaussian shows nobody where the object is."""
_MARGIN = 5
"""Cells of free room around the Gaussians."""
_FINER = 4
"""Times as many cells along the longest side of a slender object, at most."""
_STEP = 1.0
"""Depth over which a view's word goes from "not free" to "free", cells: the depth that it sees lies in the middle."""
_BLUR = 1.0
"""Standard deviation of the blur that takes the cells' steps out of the surface, cells."""
_ELEVATIONS = (-75.0, -45.0, -15.0, 15.0, 45.0, 75.0)
"""Degrees; steep ones look into open vessels."""
_AZIMUTHS = 12
_PIXELS = 256


def gaussian_surface(
    cloud: GaussianCloud,
    *,
    cameras: Sequence[Camera] | None = None,
    faces: int = 20_000,
    cells: int = 128,
    agreement: float = 0.08,
    rasteriser: Rasteriser | None = None,
) -> Surface:
    """Return the closed surface of the object that Gaussians show.

    Each camera sees a depth in each pixel; a place before it, or where the Gaussians cover less than half of the pixel,
    is free. What more than `agreement` of the cameras that have it in their image see free is not the object. `cells`
    count along the longest side, or up to four times as many while their number stays half their cube: slender objects
    are thin. Walls of three cells are kept. `cameras` are best those of the photographs, for
    Gaussians are wrong where no photograph looked; without them 72 stand around the object. The surface has at most
    `faces` triangles, or twice or four times as many where fewer would pinch it open.

    Raises SceneError for fewer than 100 Gaussians that can be seen, for numbers that are not finite, for Gaussians in
    one place, and where the cameras see no object or only a part too large for their images.
    """
    if faces < 4 or cells < 16 or not 0 < agreement < 1:
        raise SceneError(
            f"faces = {faces}, cells = {cells}, agreement = {agreement}: expected 4 triangles and 16 cells or more, "
            "and an agreement between 0 and 1"
        )
    cloud = _visible(cloud)
    rasteriser = choose_rasteriser(cloud.centers.device) if rasteriser is None else rasteriser
    lowest, spacing, shape = _grid(cloud, cells)
    cameras = _around(cloud) if cameras is None else cameras
    free, seen = _carve(depth_of_cloud(cloud, rasteriser), cameras, lowest, spacing, shape)
    if not seen.any():
        raise SceneError(
            f"none of {len(cameras)} cameras has the Gaussians in its image: cameras and Gaussians are in different "
            "frames or units (metres?); give the cameras of their photographs, or none"
        )
    share = free / np.maximum(seen, 1.0)
    # Of what few cameras have in their image nothing is known; the object is in most of them.
    solid = np.where(seen < 0.25 * seen.max(), 0.0, 1.0 - np.minimum(share / (2 * agreement), 1.0))
    blurred = ndimage.gaussian_filter(solid.astype(np.float32), _BLUR)
    blurred[[0, -1]], blurred[:, [0, -1]], blurred[:, :, [0, -1]] = 0.0, 0.0, 0.0
    try:
        return enclose(blurred, 0.5, lowest=lowest, spacing=spacing, faces=faces)
    except CaptureError as error:
        raise SceneError(f"{len(cloud)} Gaussians seen by {len(cameras)} cameras: {error}") from error


def _visible(cloud: GaussianCloud) -> GaussianCloud:
    """Return the Gaussians that are not faint. Raises SceneError where they cannot be an object."""
    for each in fields(cloud):
        values = getattr(cloud, each.name).detach()
        wrong = torch.nonzero(~torch.isfinite(values.reshape(len(values), -1)).all(1)).flatten()
        if len(wrong):
            raise SceneError(
                f"expected finite numbers, found {each.name} {values[wrong[0]].tolist()} of Gaussian {int(wrong[0])}, "
                f"and of {len(wrong) - 1} others: drop them with `GaussianCloud.take`"
            )
    visible = cloud.detach().take(cloud.opacities.detach() >= _FAINT)
    if len(visible) < _FEWEST:
        raise SceneError(
            f"{len(visible)} of {len(cloud)} Gaussians have an opacity of {_FAINT} or more; expected {_FEWEST} and "
            "more to show a surface: splat the object again, with more steps or better masks"
        )
    extent = (visible.centers.amax(0) - visible.centers.amin(0)).tolist()
    if not max(extent) > 0:
        raise SceneError(
            f"all {len(visible)} Gaussians are in one place, {visible.centers[0].tolist()}: expected them all over an "
            "object; splat it again"
        )
    return visible


def _grid(cloud: GaussianCloud, cells: int) -> tuple[Float64[np.ndarray, " 3"], float, tuple[int, int, int]]:
    """Return the middle of the first cell, the cells' edge and how many there are."""
    places = cloud.centers.cpu().double().numpy()
    low, extent = places.min(axis=0), np.ptp(places, axis=0)
    # A cell's volume is the box's over half the cells' cube, where the box is slender enough for that to be finer.
    share = float(np.prod(extent / extent.max()))
    spacing = float(extent.max()) / cells * min(max((2.0 * share) ** (1 / 3), 1 / _FINER), 1.0)
    counts = np.ceil(extent / spacing).astype(int) + 2 * _MARGIN + 1
    return low - _MARGIN * spacing, spacing, (int(counts[0]), int(counts[1]), int(counts[2]))


def _around(cloud: GaussianCloud) -> tuple[Camera, ...]:
    corners = torch.stack([cloud.centers.amin(0), cloud.centers.amax(0)]).cpu()
    box = Surface(corners, torch.zeros(0, 3, dtype=torch.long))
    return orbit_cameras(box, size=_PIXELS, elevations=_ELEVATIONS, azimuths=_AZIMUTHS)


def _carve(
    depth_map: DepthMap,
    cameras: Sequence[Camera],
    lowest: Float64[np.ndarray, " 3"],
    spacing: float,
    shape: tuple[int, int, int],
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return how many cameras see each cell to be free, and how many have it in their image."""
    free, seen = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    for camera in cameras:
        depth = depth_map(camera).cpu().double()
        reached = torch.where(depth > 0, depth, torch.inf).numpy()
        projection = (camera.intrinsics @ camera.world_to_camera[:3]).numpy()
        run_lanes(_look, lane_count(), projection, reached, lowest, spacing, _STEP * spacing, free, seen)
    return free, seen


@compiled(error_model="numpy")
@no_type_check
def _look(lane, lanes, projection, reached, first, spacing, step, free, seen):
    """Count, for each cell whose middle is in the image, that it was seen and how far it lies before the surface."""
    height, width = reached.shape
    cells = seen.shape[0]
    for i in range(lane * cells // lanes, (lane + 1) * cells // lanes):
        x = first[0] + i * spacing
        for j in range(seen.shape[1]):
            y = first[1] + j * spacing
            for k in range(seen.shape[2]):
                z = first[2] + k * spacing
                depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
                if depth <= 0.0:
                    continue
                column = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
                row = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
                if 0.0 <= column < width and 0.0 <= row < height:
                    seen[i, j, k] += 1.0
                    before = (reached[int(row), int(column)] - depth) / step + 0.5
                    free[i, j, k] += min(max(before, 0.0), 1.0)
