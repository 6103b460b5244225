"""The visual hull as a signed distance: how far inside the outlines of all masks each place lies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.photographs.cameras import View
from avmsf.reconstruction.grid import Grid

_FINER = 3
"""Times as many pixels across in which the distance to an outline is measured. It must be odd."""

_FAR = np.float32(1e6)
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
    fine = cv2.resize(mask, (width * _FINER, height * _FINER), interpolation=cv2.INTER_LINEAR) > 127
    if fine.all() or not fine.any():
        return np.full(mask.shape, float(max(mask.shape)) * (1.0 if fine.all() else -1.0), dtype=np.float32)
    solid = fine.astype(np.uint8)
    within = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Each counts to the middle of the first pixel of the other side, half a pixel beyond the outline.
    signed = np.where(fine, within - 0.5, 0.5 - beyond) / _FINER
    middle = _FINER // 2
    return np.ascontiguousarray(signed[middle::_FINER, middle::_FINER], dtype=np.float32)


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
        run_lanes(
            _measure,
            lane_count(),
            each.projection,
            each.inside,
            each.focal,
            grid.lowest,
            grid.spacing,
            rows,
            least,
            seen,
        )
    # Of what few views have in their image nothing is known, and the object is in most of them.
    known = np.isfinite(least[:, rank]) & (seen >= 0.5 * seen.max(initial=0))
    distance = np.full(grid.shape, -_FAR, dtype=np.float32)
    distance[tuple(rows.T)] = np.where(known, least[:, rank], -_FAR)
    return distance


@compiled(error_model="numpy")
@no_type_check
def _measure(lane, lanes, projection, inside, focal, lowest, spacing, rows, least, seen):
    """Sort one view's distance into the smallest of each cell."""
    height, width = inside.shape
    count, kept = least.shape
    for cell in range(lane * count // lanes, (lane + 1) * count // lanes):
        x = lowest[0] + spacing * rows[cell, 0]
        y = lowest[1] + spacing * rows[cell, 1]
        z = lowest[2] + spacing * rows[cell, 2]
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        if depth <= 0.0:
            continue
        column = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
        row = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
        if not (0.0 <= column < width and 0.0 <= row < height):
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
