"""A coarse visual hull: the places that nearly all views show as object, and where they lie in each image."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from avmsf.photographs.cameras import Camera

_COARSE, _FINE = 40**3, 80**3
# Of the views that could see a place, so many at least must be there to say anything of it.
_SEEING = 1 / 3


@dataclass(frozen=True, eq=False)
class Hull:
    """Cubes around an object with the votes of the views on each."""

    centers: Float[np.ndarray, "places 3"]
    """Object frame, meters."""
    edge: float
    """Of a cube, meters."""
    seeing: Int[np.ndarray, " places"]
    """How many views have the place inside their image."""
    agreeing: Int[np.ndarray, " places"]
    """How many of these show object there."""
    views: int
    """How many views voted."""

    def occupied(self, *, missing: int) -> Bool[np.ndarray, " places"]:
        """Return which places are object, where up to `missing` views, of as many as voted, may say otherwise."""
        allowed = np.floor(missing * self.seeing / self.views)
        enough = self.seeing >= max(2.0, _SEEING * self.views)
        return enough & (self.agreeing >= self.seeing - allowed)


def carve(masks: Sequence[Bool[np.ndarray, "height width"]], cameras: Sequence[Camera]) -> Hull | None:
    """Return the hull of the masks; None where they and their cameras agree on no place at all."""
    bounds = _bounds(masks, cameras)
    if bounds is None:
        return None
    coarse = _vote(*_cubes(*bounds, _COARSE), masks, cameras)
    inside = coarse.occupied(missing=len(masks) // 6)
    if not inside.any():
        return None
    low = coarse.centers[inside].min(axis=0) - 1.5 * coarse.edge
    high = coarse.centers[inside].max(axis=0) + 1.5 * coarse.edge
    return _vote(*_cubes(low, high, _FINE), masks, cameras)


def silhouette(
    hull: Hull, places: Bool[np.ndarray, " places"], camera: Camera
) -> tuple[Bool[np.ndarray, "height width"], float]:
    """Return where the given places lie in the camera's image, and how large a cube is there, pixels.

    The outline is as coarse as the cubes.
    """
    across, down, depth = _pixels(hull.centers[places], camera)
    ahead = depth > 0
    if not ahead.any():
        return np.zeros((camera.height, camera.width), dtype=bool), 1.0
    footprint = max(camera.focal) * hull.edge / float(np.median(depth[ahead]))
    # A cube covers at most one pixel of an image this small, so that neighbors leave no gap that closing leaves open.
    shrink = max(1.0, footprint)
    width, height = int(np.ceil(camera.width / shrink)), int(np.ceil(camera.height / shrink))
    columns, rows = np.floor(across / shrink), np.floor(down / shrink)
    seen = ahead & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    small = np.zeros((height, width), dtype=np.uint8)
    small[rows[seen].astype(int), columns[seen].astype(int)] = 1
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    column = np.minimum((np.arange(camera.width) + 0.5) / shrink, width - 1).astype(int)
    row = np.minimum((np.arange(camera.height) + 0.5) / shrink, height - 1).astype(int)
    return closed[row[:, None], column[None, :]] > 0, footprint


def _bounds(
    masks: Sequence[Bool[np.ndarray, "height width"]], cameras: Sequence[Camera]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]] | None:
    """Return the corners of a box that holds the object: the middles of the masks looked at from all sides."""
    directions, positions, angles = [], [], []
    for mask, camera in zip(masks, cameras, strict=True):
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        across = (columns + 0.5 - camera.principal[0]) / camera.focal[0]
        down = (rows + 0.5 - camera.principal[1]) / camera.focal[1]
        ray = camera.world_to_camera[:3, :3].numpy().T @ (across.mean(), down.mean(), 1.0)
        directions.append(ray / np.linalg.norm(ray))
        positions.append(camera.position.numpy())
        angles.append(float(np.hypot(across - across.mean(), down - down.mean()).max()))
    if len(directions) < 2:
        return None
    lines, places = np.array(directions), np.array(positions)
    beside = np.eye(3) - lines[:, :, None] * lines[:, None, :]
    if np.linalg.eigvalsh(beside.sum(axis=0))[0] < 1e-6 * len(lines):
        return None
    center = np.linalg.solve(beside.sum(axis=0), np.einsum("ijk,ik->j", beside, places))
    # The median, for a mask that leaked into the background is far too large.
    radius = 1.25 * float(np.median(np.array(angles) * np.linalg.norm(places - center, axis=1)))
    return center - radius, center + radius


def _cubes(
    low: Float[np.ndarray, " 3"], high: Float[np.ndarray, " 3"], count: int
) -> tuple[Float[np.ndarray, "places 3"], float]:
    """Return the centers of about `count` cubes that fill a box, and their edge."""
    edge = float(np.prod(high - low) / count) ** (1 / 3)
    steps = np.maximum(1, np.ceil((high - low) / edge)).astype(int)
    axes = [low[axis] + (np.arange(steps[axis]) + 0.5) * edge for axis in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), edge


def _vote(
    centers: Float[np.ndarray, "places 3"],
    edge: float,
    masks: Sequence[Bool[np.ndarray, "height width"]],
    cameras: Sequence[Camera],
) -> Hull:
    seeing, agreeing = np.zeros(len(centers), dtype=np.int64), np.zeros(len(centers), dtype=np.int64)
    for mask, camera in zip(masks, cameras, strict=True):
        across, down, depth = _pixels(centers, camera)
        seen = (depth > 0) & (across >= 0) & (down >= 0) & (across < camera.width) & (down < camera.height)
        rows, columns = down[seen].astype(np.int32), across[seen].astype(np.int32)
        seeing += seen
        agreeing[seen] += mask[rows, columns]
    return Hull(centers, edge, seeing, agreeing, len(masks))


def _pixels(
    points: Float[np.ndarray, "points 3"], camera: Camera
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return columns, rows and depths of points; single precision, which is a thousandth of a pixel here."""
    pose = camera.world_to_camera.numpy().astype(np.float32)
    inside = points.astype(np.float32) @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(inside[:, 2] > 0, inside[:, 2], np.float32(1.0))
    across = inside[:, 0] / depth * np.float32(camera.focal[0]) + np.float32(camera.principal[0])
    down = inside[:, 1] / depth * np.float32(camera.focal[1]) + np.float32(camera.principal[1])
    return across, down, inside[:, 2]
