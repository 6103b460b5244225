"""Depth of many views fused on a grid: how far before the surface that most views see each cell lies."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from avmsf.mesh.level_set import Grid, enclose
from avmsf.photographs.cameras import Camera
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.photographs.visual_hull import project_votes

_BINS = 32
"""Of distances before the depth that views see."""
_BAND_RATIO = 0.015
"""How far behind a view's depth cells are still seen, over the diagonal: depth of Gaussians scatters so much."""
_QUANTILE = 0.35
"""Of the distances before the surface: two thirds of the views must see a cell free."""
_MIN_VIEW_RATIO = 0.04
"""Part of the views that must see a cell for its depth to count, but three views at least."""
_BIAS_VIEWS = 24
"""Views in which the bias of depth is measured, about."""
_MAX_BIAS_RATIO = 0.05
"""Of depth, over the diagonal."""
_BIAS_FACES = 40_000
"""Triangles of the surface against which it is measured."""
_MIN_BIAS_PIXELS = 100
"""Fewest pixels of which it is the mode."""


def free_space(
    depths: Sequence[Float32[np.ndarray, "height width"]],
    cameras: Sequence[Camera],
    hull: Float32[np.ndarray, "x y z"],
    grid: Grid,
    diagonal: float,
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return how far each cell lies before the surface that views see, meters, and how many views see the cell.

    `depths` are meters along the optical axes, 0 where nothing is known; `hull` says how far inside the visual hull
    each cell lies. Depth may lie behind the surface by the same length everywhere, which is taken off.
    """
    bias = np.float32(-_bias(depths, cameras, hull, grid, diagonal))
    moved = [np.where(depth > 0, depth + bias, np.float32(0.0)) for depth in depths]
    free, counts = _fused(moved, cameras, grid, hull > -2 * grid.spacing, band=_BAND_RATIO * diagonal)
    return ndimage.gaussian_filter(free, 1.0), counts


def _bias(
    depths: Sequence[Float32[np.ndarray, "height width"]],
    cameras: Sequence[Camera],
    hull: Float32[np.ndarray, "x y z"],
    grid: Grid,
    diagonal: float,
) -> float:
    """Return by how much depth lies behind the hull where it does so most often, meters.

    Most of a surface touches its hull; the depth of cavities lies behind it by lengths of all kinds.
    """
    tracer = MeshTracer(enclose(hull, grid, _BIAS_FACES))
    behind, step = [], max(1, len(depths) // _BIAS_VIEWS)
    for depth, camera in zip(depths[::step], cameras[::step], strict=True):
        front = tracer.depth(camera).numpy()
        behind.append((depth - front)[(front > 0) & (depth > 0)])
    found = np.sort(np.concatenate(behind))
    found = found[np.abs(found) < _MAX_BIAS_RATIO * diagonal]
    if len(found) < _MIN_BIAS_PIXELS:
        return 0.0
    # The half that is closest together, again and again (half-sample mode).
    while len(found) > _MIN_BIAS_PIXELS:
        half = len(found) // 2
        start = int((found[half:] - found[:-half]).argmin())
        found = found[start : start + half + 1]
    return float(np.median(found))


def _fused(
    depths: Sequence[Float32[np.ndarray, "height width"]],
    cameras: Sequence[Camera],
    grid: Grid,
    where: Bool[np.ndarray, "x y z"],
    *,
    band: float,
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"]]:
    """Return a quantile of the views' distances before their depth, within `band`, and how many see each cell.

    A view sees a cell that lies before its depth or at most `band` behind.
    """
    cells = np.flatnonzero(where)
    counts = np.zeros((len(cells), _BINS), dtype=np.uint16)

    def count(part: slice, _view: int, reached: np.ndarray, away: np.ndarray) -> None:
        before = (reached - away) / band
        seen = np.flatnonzero((reached > 0.0) & (before >= -1.0))
        counts[part][seen, np.minimum(((before[seen] + 1.0) * 0.5 * _BINS).astype(int), _BINS - 1)] += 1

    project_votes(grid, cells, cameras, depths, count)
    total = np.cumsum(counts, axis=1, dtype=np.float32)
    wanted = _QUANTILE * total[:, -1]
    first = np.minimum((total < wanted[:, None]).sum(axis=1), _BINS - 1)
    rows = np.arange(len(cells))
    below = np.where(first > 0, total[rows, np.maximum(first - 1, 0)], 0.0)
    within = (wanted - below) / np.maximum(counts[rows, first], 1)
    distances = ((first + np.clip(within, 0.0, 1.0)) / _BINS * 2.0 - 1.0) * band
    enough = total[:, -1] >= max(3.0, _MIN_VIEW_RATIO * len(depths))
    values, seen = np.full(grid.shape, -band, dtype=np.float32), np.zeros(grid.shape, dtype=np.float32)
    values.ravel()[cells] = np.where(enough, distances, -band)
    seen.ravel()[cells] = total[:, -1]
    return values, seen
