"""The visual hull: all that no mask speaks against, carved from a box of voxels, as points to start Gaussians on."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from scipy import ndimage

from avmsf.gaussians.initialize import StartPoints, photographed_colors
from avmsf.photographs.cameras import View
from avmsf.photographs.visual_hull import Grid, count_votes, masked_views, no_common_point, object_extent, touches_edge

_COARSE_CELLS = 48
"""Voxels along the longest side of the first carving, which finds where the object is."""
_MAX_CELLS = 320
"""Voxels along the longest side at most: 130 MB of votes in a cube."""


def visual_hull(views: Sequence[View], *, points: int, wrong_fraction: float = 0.05) -> StartPoints:
    """Carve the object out of its masks, and return the middles of about `points` voxels at the surface.

    With normals outwards, as well as voxels tell them, and the colors of the photographs. A view has a say where it
    sees: what lies beyond its image's edge it leaves to the others. A voxel goes when more than `wrong_fraction` of the
    views that see it say so, so that a few wrong masks among many views carve nothing away, and when fewer than half as
    many views see it as see the middle of the object. Views without a mask are passed over, and those whose mask is
    empty, with a `CaptureWarning`. Raises `SceneError` where fewer than 3 masks remain, or masks that have nothing in
    common.
    """
    masked = masked_views(views)
    middle, reach = object_extent([view.foreground for view in masked], [view.camera for view in masked])
    # The first box is a guess: where the object touches its edge, it grows.
    for _ in range(4):
        spacing = 2 * reach / _COARSE_CELLS
        grid = Grid(middle - reach + 0.5 * spacing, spacing, (_COARSE_CELLS,) * 3)
        solid = _carve(masked, grid, wrong_fraction)
        if not touches_edge(solid):
            break
        reach *= 1.5
    for _ in range(2):
        # The surface's voxels grow with the square of the fineness.
        finer = grid.spacing * math.sqrt(max(int(_surface(solid).sum()), 1) / points)
        # From the edge of a voxel beyond the solid ones on either side.
        low, high = grid.box(solid)
        low, extent = low - 1.5 * grid.spacing, high - low + 3 * grid.spacing
        spacing = max(finer, float(extent.max()) / _MAX_CELLS)
        x, y, z = (np.ceil(extent / spacing).astype(int) + 4).tolist()
        grid = Grid(low - 1.5 * spacing, spacing, (x, y, z))
        solid = _carve(masked, grid, wrong_fraction)
    rows = np.argwhere(_surface(solid))
    centers = torch.from_numpy(grid.centers(rows)).float()
    colors = photographed_colors(centers, views, spacing=grid.spacing)
    return StartPoints(centers, colors, torch.from_numpy(_normals(solid, rows)).float())


def _carve(views: Sequence[View], grid: Grid, wrong_fraction: float) -> Bool[np.ndarray, "x y z"]:
    """Return which voxels of a grid the views leave; raises SceneError where they leave none."""
    masks, middle = [], grid.centers((np.array(grid.shape) - 1) / 2)
    for view in views:
        pose, mask = view.camera.world_to_camera.numpy(), view.foreground
        # A voxel is in the mask when some of it is: the mask grows by half a voxel, as far away as the middle is.
        depth = float(pose[2, :3] @ middle + pose[2, 3])
        grown = 0.5 * grid.spacing * view.camera.focal[0] / max(depth, 1e-9)
        if grown >= 1.0:
            mask = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) <= grown
        masks.append(mask)
    votes = count_votes(masks, [view.camera for view in views], grid)
    seen, agreed = votes.seen, votes.seen - votes.inside <= wrong_fraction * votes.seen
    counts = seen[agreed & (seen > 0)]
    enough = 0.5 * float(np.quantile(counts, 0.9)) if len(counts) else 1.0
    solid = agreed & (seen >= max(1.0, enough))
    if not solid.any():
        raise no_common_point(len(views))
    return solid


def _surface(solid: np.ndarray) -> Bool[np.ndarray, "x y z"]:
    return solid & ~ndimage.binary_erosion(solid)


def _normals(solid: np.ndarray, rows: np.ndarray) -> np.ndarray:
    smooth = ndimage.gaussian_filter(solid.astype(np.float32), 1.5)
    slopes = np.stack([-each[tuple(rows.T)] for each in np.gradient(smooth)], axis=1)
    lengths = np.linalg.norm(slopes, axis=1, keepdims=True)
    # A voxel alone has no side that is out; any direction will do.
    return np.where(lengths > 1e-6, slopes / np.maximum(lengths, 1e-6), np.array([0.0, 0.0, 1.0]))
