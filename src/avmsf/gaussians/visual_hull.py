"""The visual hull: all that no mask speaks against, carved from a box of voxels, as points to start Gaussians on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.photographs.cameras import View
from avmsf.photographs.extent import masked_views, no_common_point, object_extent

_ROUGH = 48
"""Voxels along the longest side of the first carving, which finds where the object is."""
_FINEST = 320
"""Voxels along the longest side at most: 130 MB of votes in a cube."""


@dataclass(frozen=True, eq=False)
class Hull:
    """The surface of what the masks leave."""

    points: Float[Tensor, "points 3"]
    """Middles of the voxels at the surface, meters."""
    normals: Float[Tensor, "points 3"]
    """Unit normals, outwards, as well as voxels tell them."""
    spacing: float
    """Edge of a voxel, meters."""


def visual_hull(views: Sequence[View], *, points: int, wrong_fraction: float = 0.05) -> Hull:
    """Carve the object out of its masks, finely enough for about `points` voxels at the surface.

    A view has a say where it sees: what lies beyond its image's edge it leaves to the others. A voxel goes when more
    than `wrong_fraction` of the views that see it say so, so that a few wrong masks among many views carve nothing
    away, and when fewer than half as many views see it as see the middle of the object. Views without a mask are passed
    over, and those whose mask is empty, with a `CaptureWarning`. Raises `SceneError` where fewer than 3 masks remain,
    or masks that have nothing in common.
    """
    masked = masked_views(views)
    middle, reach = object_extent(masked)
    lowest, spacing = middle - reach, 2 * reach / _ROUGH
    shape = (_ROUGH,) * 3
    # The rough box is a guess: where the object touches its edge, it grows.
    for _ in range(4):
        solid = _carve(masked, lowest, spacing, shape, wrong_fraction)
        if not solid.any() or not _touches_edge(solid):
            break
        reach *= 1.5
        lowest, spacing = middle - reach, 2 * reach / _ROUGH
    _expect_something(solid, masked)
    for _ in range(2):
        # The surface's voxels grow with the square of the fineness.
        finer = spacing * math.sqrt(max(int(_surface(solid).sum()), 1) / points)
        lowest, extent = _box(solid, lowest, spacing)
        spacing = max(finer, float(extent.max()) / _FINEST)
        shape = (*(np.ceil(extent / spacing).astype(int) + 4).tolist(),)
        lowest = lowest - 2 * spacing
        solid = _carve(masked, lowest, spacing, shape, wrong_fraction)
        _expect_something(solid, masked)
    rows = np.argwhere(_surface(solid))
    normals = _normals(solid, rows)
    places = lowest + (rows + 0.5) * spacing
    return Hull(torch.from_numpy(places).float(), torch.from_numpy(normals).float(), spacing)


def _carve(
    views: Sequence[View], lowest: np.ndarray, spacing: float, shape: tuple[int, ...], wrong_fraction: float
) -> np.ndarray:
    """Return which voxels of a grid the views leave."""
    seen, against = np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=np.uint16)
    middle = lowest + 0.5 * spacing * np.array(shape)
    for view in views:
        assert view.mask is not None
        pose, mask = view.camera.world_to_camera.numpy(), view.mask.numpy() > 127
        # A voxel is in the mask when some of it is: the mask grows by half a voxel, as far away as the middle is.
        depth = float(pose[2, :3] @ middle + pose[2, 3])
        grown = 0.5 * spacing * view.camera.focal[0] / max(depth, 1e-9)
        if grown >= 1.0:
            mask = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) <= grown
        projection = view.camera.intrinsics.numpy() @ pose[:3]
        run_lanes(_vote, lane_count(), projection, mask, lowest + 0.5 * spacing, spacing, seen, against)
    agreed = against <= wrong_fraction * seen
    counts = seen[agreed & (seen > 0)]
    enough = 0.5 * float(np.quantile(counts, 0.9)) if len(counts) else 1.0
    return agreed & (seen >= max(1.0, enough))


@compiled(error_model="numpy")
@no_type_check
def _vote(lane, lanes, projection, mask, first, spacing, seen, against):
    """Count, for each voxel whose middle is in the image, that it was seen and whether the mask speaks against it."""
    height, width = mask.shape
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
                    seen[i, j, k] += 1
                    if not mask[int(row), int(column)]:
                        against[i, j, k] += 1


def _touches_edge(solid: np.ndarray) -> bool:
    return any(solid.take(end, axis=axis).any() for axis in range(3) for end in (0, -1))


def _surface(solid: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    return solid & ~ndimage.binary_erosion(solid)


def _box(solid: np.ndarray, lowest: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest corner and the extent of the box around the solid voxels, and one more on each side."""
    rows = np.argwhere(solid)
    first, last = rows.min(0) - 1, rows.max(0) + 2
    return lowest + first * spacing, (last - first) * spacing


def _normals(solid: np.ndarray, rows: np.ndarray) -> np.ndarray:
    smooth = ndimage.gaussian_filter(solid.astype(np.float32), 1.5)
    slopes = np.stack([-each[tuple(rows.T)] for each in np.gradient(smooth)], axis=1)
    lengths = np.linalg.norm(slopes, axis=1, keepdims=True)
    # A voxel alone has no side that is out; any direction will do.
    return np.where(lengths > 1e-6, slopes / np.maximum(lengths, 1e-6), np.array([0.0, 0.0, 1.0]))


def _expect_something(solid: np.ndarray, views: Sequence[View]) -> None:
    if not solid.any():
        raise no_common_point(len(views))
