"""Signed distances on a grid of cells.

How far inside the outlines of all masks, or a convex hull, each place lies, and how far before the surface that most
views see.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int
from scipy.spatial import ConvexHull, QhullError

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.errors import SceneError
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.hull import Grid

_SUBPIXELS = 3
"""Times as many pixels across in which the distance to an outline is measured. It must be odd."""

_BINS = 32
"""Of distances before the depth that views see."""

_OUTSIDE_M = np.float32(1e6)
"""Meters outside, of what is not known to be inside."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of an object in one view."""

    projection: Float64[np.ndarray, "3 4"]
    """Takes places in the object frame, meters, to homogeneous pixels times their depth."""
    focal: float
    """Pixels."""
    inside: Float32[np.ndarray, "height width"]
    """How far inside the outline the middle of each pixel lies, pixels; negative outside."""

    @classmethod
    def of(cls, view: View) -> "Outline":
        """Return the outline in a view's mask: where it covers half of a pixel, between pixels by interpolation."""
        assert view.mask is not None
        camera = view.camera
        projection = (camera.intrinsics @ camera.world_to_camera[:3]).numpy()
        return cls(projection, float(np.sqrt(camera.focal[0] * camera.focal[1])), _inside(view.mask.numpy()))

    def moved_in(self, pixels: float) -> "Outline":
        """Return the outline moved inwards by so many pixels."""
        return replace(self, inside=self.inside - np.float32(pixels))


def _inside(mask: np.ndarray) -> Float32[np.ndarray, "height width"]:
    """Return the signed distance of each pixel's middle from the outline, pixels."""
    height, width = mask.shape
    fine = cv2.resize(mask, (width * _SUBPIXELS, height * _SUBPIXELS), interpolation=cv2.INTER_LINEAR) > 127
    if fine.all() or not fine.any():
        return np.full(mask.shape, float(max(mask.shape)) * (1.0 if fine.all() else -1.0), dtype=np.float32)
    solid = fine.astype(np.uint8)
    within = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Each counts to the middle of the first pixel of the other side, half a pixel beyond the outline.
    signed = np.where(fine, within - 0.5, 0.5 - beyond) / _SUBPIXELS
    middle = _SUBPIXELS // 2
    return np.ascontiguousarray(signed[middle::_SUBPIXELS, middle::_SUBPIXELS], dtype=np.float32)


def hull_distance(
    outlines: Sequence[Outline], grid: Grid, where: Bool[np.ndarray, "x y z"] | None = None, *, rank: int
) -> Float32[np.ndarray, "x y z"]:
    """Return how far inside the hull each cell's middle lies, meters.

    The distance is the `rank`-th smallest (0 for the smallest) over views of the distance from the outline at the
    cell's depth, negative outside. It is -1e6 where fewer than half as many views have the cell in their image as have
    any, and in cells that are not `where`.
    """
    rows = np.argwhere(np.ones(grid.shape, dtype=bool) if where is None else where)
    least = np.full((len(rows), rank + 1), np.inf, dtype=np.float32)
    seen = np.zeros(len(rows), dtype=np.uint16)
    for each in outlines:
        outline = each.projection, each.inside, each.focal
        run_lanes(_measure, lane_count(), *outline, grid.lowest, grid.spacing, rows, least, seen)
    # Of what few views have in their image nothing is known, and the object is in most of them.
    known = np.isfinite(least[:, rank]) & (seen >= 0.5 * seen.max(initial=0))
    distance = np.full(grid.shape, -_OUTSIDE_M, dtype=np.float32)
    distance[tuple(rows.T)] = np.where(known, least[:, rank], -_OUTSIDE_M)
    return distance


@compiled(error_model="numpy", inline="always")
@no_type_check
def _pixel(projection, lowest, spacing, place):
    """Return the depth, row and column of the middle of a cell in a view."""
    x, y, z = lowest[0] + spacing * place[0], lowest[1] + spacing * place[1], lowest[2] + spacing * place[2]
    depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
    column = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
    row = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
    return depth, row, column


@compiled(error_model="numpy")
@no_type_check
def _measure(lane, lanes, projection, inside, focal, lowest, spacing, rows, least, seen):
    """Sort one view's distance into the smallest of each cell."""
    height, width = inside.shape
    count, kept = least.shape
    for cell in range(lane * count // lanes, (lane + 1) * count // lanes):
        depth, row, column = _pixel(projection, lowest, spacing, rows[cell])
        if not (depth > 0.0 and 0.0 <= column < width and 0.0 <= row < height):
            continue
        seen[cell] += 1
        across, down = min(max(column - 0.5, 0.0), width - 1.001), min(max(row - 0.5, 0.0), height - 1.001)
        left, top = int(across), int(down)
        a, b = across - left, down - top
        upper = (1 - a) * inside[top, left] + a * inside[top, left + 1]
        lower = (1 - a) * inside[top + 1, left] + a * inside[top + 1, left + 1]
        value = ((1 - b) * upper + b * lower) * depth / focal
        for place in range(kept):
            if value < least[cell, place]:
                value, least[cell, place] = least[cell, place], value


def depth_in_convex_hull(
    points: Float64[np.ndarray, "points 3"], grid: Grid, rows: Int[np.ndarray, "cells 3"]
) -> Float32[np.ndarray, " cells"]:
    """Return how far inside the convex hull of points the middles of cells lie, meters, negative outside.

    Raises SceneError for points in one plane.
    """
    try:
        planes = ConvexHull(points).equations
    except QhullError as error:
        raise SceneError.expected(
            "points that span a volume", len(points), got=f"{len(points)} in one plane", name="points"
        ) from error
    # Triangles of one flat face share their plane.
    planes = np.unique(np.round(planes, 6), axis=0)
    result = np.full(len(rows), np.inf, dtype=np.float32)
    run_lanes(_depth_below_planes, lane_count(), planes, grid.lowest, grid.spacing, rows, result)
    return result


@compiled(error_model="numpy")
@no_type_check
def _depth_below_planes(lane, lanes, planes, lowest, spacing, rows, result):
    count = rows.shape[0]
    for cell in range(lane * count // lanes, (lane + 1) * count // lanes):
        x = lowest[0] + spacing * rows[cell, 0]
        y = lowest[1] + spacing * rows[cell, 1]
        z = lowest[2] + spacing * rows[cell, 2]
        least = np.inf
        for plane in range(planes.shape[0]):
            least = min(least, -(planes[plane, 0] * x + planes[plane, 1] * y + planes[plane, 2] * z + planes[plane, 3]))
        result[cell] = least


@dataclass(frozen=True, eq=False)
class SeenDepth:
    """The depth of the first surface that one view sees."""

    camera: Camera
    depth: Float32[np.ndarray, "height width"]
    """Meters along the optical axis; 0 where nothing is known."""

    @classmethod
    def of(cls, view: View, depth: Float32[np.ndarray, "height width"]) -> "SeenDepth":
        """Return the depth inside a view's mask: at the outline a pixel's depth is the background's in part."""
        assert view.mask is not None
        return cls(view.camera, np.where(view.mask.numpy() > 127, depth, np.float32(0.0)).astype(np.float32))

    def moved(self, meters: float) -> "SeenDepth":
        """Return the depth that lies so much farther away, where it is known."""
        return replace(self, depth=np.where(self.depth > 0, self.depth + np.float32(meters), np.float32(0.0)))


def fused_depth(
    views: Sequence[SeenDepth],
    grid: Grid,
    where: Bool[np.ndarray, "x y z"],
    *,
    band: float,
    quantile: float,
    least: float,
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return how far each cell lies before the surface, meters within `band`, and how many views see the cell.

    A view sees a cell that lies before its depth or at most `band` behind. The distance is the `quantile` of theirs.
    """
    rows = np.argwhere(where)
    counts = np.zeros((len(rows), _BINS), dtype=np.uint8)
    for each in views:
        projection = (each.camera.intrinsics @ each.camera.world_to_camera[:3]).numpy()
        run_lanes(_count, lane_count(), projection, each.depth, grid.lowest, grid.spacing, rows, band, counts)
    total = np.cumsum(counts, axis=1, dtype=np.float32)
    view_counts = total[:, -1]
    wanted = quantile * view_counts
    first = np.minimum((total < wanted[:, None]).sum(axis=1), _BINS - 1)
    at = np.arange(len(rows))
    before = np.where(first > 0, total[at, np.maximum(first - 1, 0)], 0.0)
    within = (wanted - before) / np.maximum(counts[at, first], 1)
    value = ((first + np.clip(within, 0.0, 1.0)) / _BINS * 2.0 - 1.0) * band
    values = np.full(grid.shape, -band, dtype=np.float32)
    seen = np.zeros(grid.shape, dtype=np.float32)
    values[tuple(rows.T)] = np.where(view_counts >= least, value, -band)
    seen[tuple(rows.T)] = view_counts
    return values, seen


@compiled(error_model="numpy")
@no_type_check
def _count(lane, lanes, projection, reached, lowest, spacing, rows, band, counts):
    """Count one view's distance before its depth in the bin of each cell."""
    height, width = reached.shape
    count, bins = counts.shape
    for cell in range(lane * count // lanes, (lane + 1) * count // lanes):
        depth, row, column = _pixel(projection, lowest, spacing, rows[cell])
        if not (depth > 0.0 and 0.0 <= column < width and 0.0 <= row < height):
            continue
        there = reached[int(row), int(column)]
        if there <= 0.0:
            continue
        before = (there - depth) / band
        if before < -1.0:
            continue
        place = min(int((before + 1.0) * 0.5 * bins), bins - 1)
        if counts[cell, place] < 255:
            counts[cell, place] += 1
