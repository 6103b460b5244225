"""Signed distances on a grid of cells.

How far inside the outlines of all masks, or a convex hull, each place lies, and how far before the surface that most
views see.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import ConvexHull, QhullError

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.errors import SceneError
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.visual_hull import Grid, project_votes

_SUBPIXELS = 3
"""Times as many pixels across in which the distance to an outline is measured. It must be odd."""

_BINS = 32
"""Of distances before the depth that views see."""

_OUTSIDE_M = np.float32(1e6)
"""Meters outside, of what is not known to be inside."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of an object in one view."""

    camera: Camera
    inside: Float32[np.ndarray, "height width"]
    """How far inside the outline the middle of each pixel lies, pixels; negative outside."""

    @classmethod
    def of(cls, view: View) -> "Outline":
        """Return the outline in a view's mask: where it covers half of a pixel, between pixels by interpolation."""
        assert view.mask is not None
        return cls(view.camera, _inside(view.mask.numpy()))

    @property
    def focal(self) -> float:
        """The camera's focal length, pixels."""
        return float(np.sqrt(self.camera.focal[0] * self.camera.focal[1]))

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
    cells = np.flatnonzero(np.ones(grid.shape, dtype=bool) if where is None else where)
    least = np.full((rank + 1, len(cells)), np.inf, dtype=np.float32)
    seen = np.zeros(len(cells), dtype=np.uint16)

    def keep_least(part: slice, view: int, values: np.ndarray, depths: np.ndarray) -> None:
        distances = (values * depths / outlines[view].focal).astype(np.float32)
        seen[part] += ~np.isnan(values)
        for row in least[:, part]:
            distances, row[:] = np.fmax(row, distances), np.fmin(row, distances)

    cameras, images = [each.camera for each in outlines], [each.inside for each in outlines]
    project_votes(grid, cells, cameras, images, keep_least, linear=True)
    # Of what few views have in their image nothing is known, and the object is in most of them.
    known = np.isfinite(least[rank]) & (seen >= 0.5 * seen.max(initial=0))
    distance = np.full(grid.shape, -_OUTSIDE_M, dtype=np.float32)
    distance.ravel()[cells] = np.where(known, least[rank], -_OUTSIDE_M)
    return distance


def depth_in_convex_hull(
    points: Float64[np.ndarray, "points 3"], positions: Float64[np.ndarray, "positions 3"]
) -> Float32[np.ndarray, " positions"]:
    """Return how far inside the convex hull of points positions lie, meters, negative outside.

    Raises SceneError for points in one plane.
    """
    try:
        planes = ConvexHull(points).equations
    except QhullError as error:
        got = f"{len(points)} in one plane"
        raise SceneError.expected("points that span a volume", len(points), got=got, name="points") from error
    # Triangles of one flat face share their plane.
    planes = np.unique(np.round(planes, 6), axis=0)
    result = np.full(len(positions), np.inf, dtype=np.float32)
    run_lanes(_depth_below_planes, lane_count(), planes, positions, result)
    return result


@compiled(error_model="numpy")
@no_type_check
def _depth_below_planes(lane, lanes, planes, positions, result):
    count = len(positions)
    for row in range(lane * count // lanes, (lane + 1) * count // lanes):
        x, y, z = positions[row]
        least = np.inf
        for plane in range(len(planes)):
            least = min(least, -(planes[plane, 0] * x + planes[plane, 1] * y + planes[plane, 2] * z + planes[plane, 3]))
        result[row] = least


@dataclass(frozen=True, eq=False)
class SeenDepth:
    """The depth of the first surface that one view sees."""

    camera: Camera
    depth: Float32[np.ndarray, "height width"]
    """Meters along the optical axis; 0 where nothing is known."""

    @classmethod
    def of(cls, view: View, depth: Float32[np.ndarray, "height width"]) -> "SeenDepth":
        """Return the depth inside a view's mask: at the outline a pixel's depth is the background's in part."""
        return cls(view.camera, np.where(view.foreground, depth, np.float32(0.0)).astype(np.float32))

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
    cells = np.flatnonzero(where)
    counts = np.zeros((len(cells), _BINS), dtype=np.uint16)

    def count(part: slice, _: int, reached: np.ndarray, depths: np.ndarray) -> None:
        before = (reached - depths) / band
        known = np.flatnonzero((reached > 0.0) & (before >= -1.0))
        counts[part][known, np.minimum(((before[known] + 1.0) * 0.5 * _BINS).astype(int), _BINS - 1)] += 1

    project_votes(grid, cells, [each.camera for each in views], [each.depth for each in views], count)
    total = np.cumsum(counts, axis=1, dtype=np.float32)
    view_counts = total[:, -1]
    wanted = quantile * view_counts
    first = np.minimum((total < wanted[:, None]).sum(axis=1), _BINS - 1)
    at = np.arange(len(cells))
    before = np.where(first > 0, total[at, np.maximum(first - 1, 0)], 0.0)
    within = (wanted - before) / np.maximum(counts[at, first], 1)
    value = ((first + np.clip(within, 0.0, 1.0)) / _BINS * 2.0 - 1.0) * band
    values = np.full(grid.shape, -band, dtype=np.float32)
    seen = np.zeros(grid.shape, dtype=np.float32)
    values.ravel()[cells] = np.where(view_counts >= least, value, -band)
    seen.ravel()[cells] = view_counts
    return values, seen
