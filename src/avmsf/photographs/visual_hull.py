"""The visual hull: what no mask speaks against, by the votes of views on cells; and where their object is."""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64, Shaped, UInt16

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.errors import CaptureWarning, SceneError
from avmsf.mesh.level_set import Grid
from avmsf.photographs.cameras import MIN_VIEWS, Camera, View

MIN_VIEW_RATIO = 1 / 3
"""Part of the views that must have a cell in their image for it to be object."""
_CELLS_AT_ONCE = 1 << 16
"""Cells that all views vote on before the next ones: their values stay in the processor's cache."""


def project_votes(
    grid: Grid,
    cells: Int64[np.ndarray, " cells"],
    cameras: Sequence[Camera],
    images: Sequence[Shaped[np.ndarray, "_ _"]],
    reduce: Callable[[slice, int, Float64[np.ndarray, " part"], Float64[np.ndarray, " part"]], None],
    *,
    linear: bool = False,
) -> None:
    """Let each view's image vote on the middles of a grid's cells, given by their flat indices.

    Calls `reduce(part, view, values, depths)` for parts of the cells and each view: the image's values at the pixels
    that the cells' middles lie in, or `linear` between the middles of pixels, NaN beyond the image and behind the
    camera; and the depths along the optical axis, meters.
    """
    projections = [camera.projection.numpy() for camera in cameras]
    for start in range(0, len(cells), _CELLS_AT_ONCE):
        part = slice(start, start + _CELLS_AT_ONCE)
        values, depths = np.empty((2, len(cells[part])))
        for view, (projection, image) in enumerate(zip(projections, images, strict=True)):
            where = grid.lowest, grid.spacing, grid.shape, cells[part]
            run_lanes(_sample, lane_count(), projection, image, linear, *where, values, depths)
            reduce(part, view, values, depths)


@compiled(error_model="numpy")
@no_type_check
def _sample(lane, lanes, projection, image, linear, lowest, spacing, shape, cells, values, depths):
    height, width = image.shape
    count = len(cells)
    for cell in range(lane * count // lanes, (lane + 1) * count // lanes):
        row, k = divmod(cells[cell], shape[2])
        i, j = divmod(row, shape[1])
        x, y, z = lowest[0] + i * spacing, lowest[1] + j * spacing, lowest[2] + k * spacing
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        across = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
        down = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
        values[cell], depths[cell] = np.nan, depth
        if not (depth > 0.0 and 0.0 <= across < width and 0.0 <= down < height):
            continue
        if not linear:
            values[cell] = image[int(down), int(across)]
            continue
        across, down = min(max(across - 0.5, 0.0), width - 1.001), min(max(down - 0.5, 0.0), height - 1.001)
        left, top = int(across), int(down)
        a, b = across - left, down - top
        upper = (1 - a) * image[top, left] + a * image[top, left + 1]
        lower = (1 - a) * image[top + 1, left] + a * image[top + 1, left + 1]
        values[cell] = (1 - b) * upper + b * lower


@dataclass(frozen=True, eq=False)
class Votes:
    """What the masks of views say of each cell of a grid."""

    grid: Grid
    seen: UInt16[np.ndarray, "x y z"]
    """How many views have the cell's middle in their image."""
    inside: UInt16[np.ndarray, "x y z"]
    """How many of these show object there."""
    views: int
    """How many views voted."""

    def occupied(self, *, missing: int) -> Bool[np.ndarray, "x y z"]:
        """Return which cells are object, where up to `missing` views, of as many as voted, may say otherwise."""
        allowed = np.floor(missing * self.seen.astype(np.float64) / self.views)
        enough = self.seen >= max(2.0, MIN_VIEW_RATIO * self.views)
        return enough & (self.inside >= self.seen - allowed)


def count_votes(masks: Sequence[Bool[np.ndarray, "_ _"]], cameras: Sequence[Camera], grid: Grid) -> Votes:
    """Return the votes of masks on the cells of a grid."""
    seen, inside = np.zeros((2, math.prod(grid.shape)), dtype=np.uint16)

    def count(part: slice, _view: int, values: np.ndarray, _depths: np.ndarray) -> None:
        seen[part] += values >= 0
        inside[part] += values > 0

    project_votes(grid, np.arange(len(seen)), cameras, masks, count)
    return Votes(grid, seen.reshape(grid.shape), inside.reshape(grid.shape), len(masks))


def carve(masks: Sequence[Bool[np.ndarray, "_ _"]], cameras: Sequence[Camera]) -> Votes | None:
    """Return the votes of masks around their hull; None where they and their cameras agree on no point at all."""
    if sum(mask.any() for mask in masks) < 2:
        return None
    try:
        middle, reach = object_extent(masks, cameras)
    except SceneError:
        return None
    coarse = count_votes(masks, cameras, Grid.filling(middle - reach, middle + reach, cells=50**3))
    inside = coarse.occupied(missing=len(masks) // 6)
    if not inside.any():
        return None
    low, high = coarse.grid.box(inside)
    margin = 1.5 * coarse.grid.spacing
    return count_votes(masks, cameras, Grid.filling(low - margin, high + margin, cells=80**3))


def silhouette(
    centers: Float64[np.ndarray, "cells 3"], edge: float, camera: Camera
) -> tuple[Bool[np.ndarray, "height width"], float]:
    """Return where cells of this edge with these centers lie in the camera's image, and how large one is there, pixels.

    The outline is as coarse as the cells.
    """
    pixels, depth = (values.numpy() for values in camera.project(torch.from_numpy(centers)))
    ahead = depth > 0
    if not ahead.any():
        return np.zeros((camera.height, camera.width), dtype=bool), 1.0
    footprint = max(camera.focal) * edge / float(np.median(depth[ahead]))
    # A cell covers at most one pixel of an image this small, so that neighbors leave no gap that closing leaves open.
    shrink = max(1.0, footprint)
    size = np.ceil(np.array([camera.width, camera.height]) / shrink).astype(int)
    cells = np.floor(pixels[ahead] / shrink).astype(int)
    columns, rows = cells[((cells >= 0) & (cells < size)).all(axis=1)].T
    small = np.zeros((size[1], size[0]), dtype=np.uint8)
    small[rows, columns] = 1
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    column = np.minimum((np.arange(camera.width) + 0.5) / shrink, size[0] - 1).astype(int)
    row = np.minimum((np.arange(camera.height) + 0.5) / shrink, size[1] - 1).astype(int)
    return closed[row[:, None], column[None, :]] > 0, footprint


def masked_views(views: Sequence[View]) -> list[View]:
    """Return the views whose masks show something; a CaptureWarning names those whose masks are empty.

    Raises SceneError for fewer than `MIN_VIEWS`.
    """
    known = [view for view in views if view.mask is not None]
    shown = [view for view in known if view.foreground.any()]
    empty = [view.name for view in known if view not in shown]
    if empty and not shown:
        wanted, got = "the object in the masks", f"only background in all {len(known)}"
        advice = "check that white is the object, or remove the masks so that the foreground is found"
        raise SceneError.expected(wanted, empty, got=got, name="masks", advice=advice)
    if empty:
        message = f"views whose masks are empty are not used: {', '.join(empty)}"
        warnings.warn(CaptureWarning(message, name="masks", value=empty), stacklevel=3)
    if len(shown) < MIN_VIEWS:
        wanted, got = f"{MIN_VIEWS} or more views with a mask", f"{len(shown)} of {len(views)}"
        advice = "give masks, images with alpha or a plain background, or initial points"
        raise SceneError.expected(wanted, len(shown), got=got, name="views", advice=advice)
    return shown


def no_common_point(views: int) -> SceneError:
    """Return the error of masks of this many views that no point of the object frame lies in."""
    advice = (
        "check that cameras and masks belong together and that the poses have the convention of their file (shifted or "
        "small masks miss thin objects)"
    )
    got = f"none from {views} views"
    return SceneError.expected("masks with a common volume", views, got=got, name="masks", advice=advice)


def object_extent(
    masks: Sequence[Bool[np.ndarray, "_ _"]], cameras: Sequence[Camera]
) -> tuple[Float64[np.ndarray, " 3"], float]:
    """Return about where the object's middle is, [3] in the object frame, and how far it reaches from there, meters.

    The middle is the point nearest to the lines of sight through the masks' middles; those that miss it by far have
    little weight (iteratively reweighted least squares). Masks without an object say nothing. Raises SceneError where
    all others' cameras are in one place.
    """
    positions, directions, sizes = [], [], []
    for mask, camera in zip(masks, cameras, strict=True):
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        pixel = np.array([np.median(columns) + 0.5, np.median(rows) + 0.5])
        ray = np.append((pixel - camera.principal) / camera.focal, 1.0)
        rotation = camera.world_to_camera[:3, :3].numpy()
        directions.append(ray / np.linalg.norm(ray) @ rotation)
        positions.append(camera.position.numpy())
        sizes.append(max(np.ptp(columns) / camera.focal[0], np.ptp(rows) / camera.focal[1]))
    starts, rays = np.stack(positions), np.stack(directions)
    if float(np.ptp(starts, axis=0).max()) <= 1e-6 * float(np.abs(starts).max()) + 1e-12:
        # Lines of sight from one place meet in the cameras alone.
        raise no_common_point(len(starts))
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weight = np.ones(len(rays))
    for _ in range(10):
        weighted = across * weight[:, None, None]
        # Parallel lines of sight leave one direction open, which the minimum norm solution sets to 0.
        middle = np.linalg.lstsq(weighted.sum(0), np.einsum("vij,vj->i", weighted, starts), rcond=1e-9)[0]
        missed = np.linalg.norm(np.einsum("vij,vj->vi", across, middle - starts), axis=1)
        weight = 1.0 / (missed + 1e-3 * np.median(np.linalg.norm(middle - starts, axis=1)))
    distance = np.abs(np.einsum("vi,vi->v", middle - starts, rays))
    # Half the largest extent, and as much again as the middle of a mask may lie off the object's.
    return middle, float(0.8 * np.quantile(np.array(sizes) * distance, 0.9))
