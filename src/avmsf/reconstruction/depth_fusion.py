"""Depth of many views fused on a grid: how far before the surface that most views see each place lies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.photographs.cameras import Camera, View
from avmsf.reconstruction.visual_hull import Grid

_BINS = 32


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
        there = reached[int(row), int(column)]
        if there <= 0.0:
            continue
        before = (there - depth) / band
        if before < -1.0:
            continue
        place = min(int((before + 1.0) * 0.5 * bins), bins - 1)
        if counts[cell, place] < 255:
            counts[cell, place] += 1
