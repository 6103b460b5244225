"""Where Gaussians start: points with colors, of the visual hull or others, each a small soft ball.

The visual hull is all that no mask speaks against, carved from a box of voxels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import ZEROTH, GaussianCloud
from avmsf.mesh.level_set import Grid, touches_edge
from avmsf.photographs.cameras import View
from avmsf.photographs.visual_hull import count_votes, masked_views, no_common_point, object_extent


@dataclass(frozen=True, eq=False)
class StartPoints:
    """Points to start Gaussians at: of structure from motion, of a surface, of a visual hull."""

    points: Float[Tensor, "points 3"]
    """Meters."""
    colors: Float[Tensor, "points 3"]
    """Red, green, blue, 0 to 1."""
    normals: Float[Tensor, "points 3"] | None = None
    """Unit normals to the surface, where they are known."""

    def __post_init__(self) -> None:
        if len(self.points) < 4 or not all(bool(torch.isfinite(each).all()) for each in (self.points, self.colors)):
            advice = "give others, or masks for a visual hull"
            raise SceneError.expected(
                "4 or more finite ones on the object", len(self.points), name="points", advice=advice
            )


def starting_cloud(
    start: StartPoints, *, degree: int, scale: float, opacity: float, flatness: float = 1.0
) -> GaussianCloud:
    """Return one Gaussian a point, `scale` mean distances to its 3 nearest neighbors wide (3DGS, section 5.1).

    Round, or where normals are known a disc across the normal, `flatness` times as thick as wide. Where points
    coincide, the width is a thousandth of their bounding box's diagonal at least. Raises SceneError where all do.
    """
    count = len(start.points)
    places = start.points.double().numpy()
    nearest = cKDTree(places).query(places, k=4)[0][:, 1:].mean(1)
    least = 1e-3 * float(np.linalg.norm(np.ptp(places, axis=0)))
    if not least > 0.0:
        raise SceneError.expected("points on the object", count, got=f"{count} at one position", name="points")
    scales = torch.from_numpy(np.log(np.maximum(scale * nearest, least))).float()[:, None].repeat(1, 3)
    harmonics = torch.zeros(count, (degree + 1) ** 2, 3)
    harmonics[:, 0] = (start.colors - 0.5) / ZEROTH
    if start.normals is None:
        rotations = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    else:
        rotations = _rotations_to(start.normals.float())
        scales[:, 2] += math.log(flatness)
    logits = torch.full((count,), math.log(opacity / (1.0 - opacity)))
    return GaussianCloud(start.points.float().clone(), rotations, scales, logits, harmonics)


def _rotations_to(normals: Float[Tensor, "points 3"]) -> Float[Tensor, "points 4"]:
    """Return quaternions of the shortest rotations that take the z axis to the normals."""
    x, y, z = normals.unbind(1)
    # From z to -z every way is equally short: about the x axis.
    opposite = z < -1.0 + 1e-6
    quaternions = torch.stack([1.0 + z, -y, x, torch.zeros_like(x)], dim=1)
    quaternions[opposite] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(quaternions, dim=1)


def photographed_colors(
    points: Float[Tensor, "points 3"], views: Sequence[View], *, spacing: float
) -> Float[Tensor, "points 3"]:
    """Return the middle (median) of each point's colors in the views that see it, gray where none does.

    The points hide one another as balls of `spacing`, meters, would; what lies less than two of these behind the
    foremost is seen as well. Where they stand out from the object, some views show what is beside it: hence no mean.
    """
    shown = np.full((len(views), len(points), 3), np.nan, dtype=np.float32)
    for row, view in enumerate(views):
        places, depths = view.camera.project(points)
        # One cell of the depth map is as wide as a ball, so that the balls of a surface leave no gap.
        cell = max(1.0, spacing * view.camera.focal[0] / max(float(depths.median()), 1e-9))
        inside = view.camera.contains(places)
        place, depth = places[inside].numpy(), depths[inside].numpy()
        cells = (place / cell).astype(np.int64)
        foremost = np.full((int(view.camera.height / cell) + 1, int(view.camera.width / cell) + 1), np.inf)
        np.minimum.at(foremost, (cells[:, 1], cells[:, 0]), depth)
        seen = depth <= foremost[cells[:, 1], cells[:, 0]] + 2 * spacing
        pixels = place[seen].astype(np.int64)
        chosen = np.flatnonzero(inside.numpy())[seen]
        shown[row, chosen] = view.image.numpy()[pixels[:, 1], pixels[:, 0]] / 255.0
    colors = np.full((len(points), 3), 0.5, dtype=np.float32)
    known = np.isfinite(shown[:, :, 0]).any(0)
    colors[known] = np.nanmedian(shown[:, known], axis=0)
    return torch.from_numpy(colors)


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
