"""From ellipses in the image to pixels: the second half of rasterizing, with its gradient.

Every pixel takes the Gaussians of its tile from front to back. One that covers alpha of it gives alpha T of its color
and leaves T (1 - alpha) of what lies behind, until less than 1e-4 is left (3DGS). The gradient takes them from back to
front, dividing T by 1 - alpha again, and writes one row for each pair of tile and Gaussian; these are summed at the end
in an order that does not depend on the number of threads.
"""

import math
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.gaussians.rasterizer.ellipses import MIN_ALPHA
from avmsf.gaussians.rasterizer.pixels import PIXELS, SIDE, blend, blend_back, working_numbers
from avmsf.gaussians.rasterizer.tiles import count_tiles, fill_tiles

_WIDTH = 16
"""Numbers a Gaussian's packed row holds: one cache line."""
_SCALE = np.float32(np.sqrt(0.5 / np.log(2.0)))
"""Takes standard deviations to such units that a Gaussian is 2 to minus their square."""
_REACH_MARGIN = 1e-4
"""By how much the squared reach is widened, so that rounding of the ellipse's edge loses no pixel that counts."""
_LOG2_MIN_ALPHA = np.float32(np.log2(MIN_ALPHA))
_TILE_WORK = 8
"""A tile itself takes about as long as this many Gaussians on it."""


class Blending(torch.autograd.Function):
    """Color, coverage and depth of every pixel from the Gaussians' ellipses."""

    @staticmethod
    def forward(
        ctx: Any,
        screen: Float32[Tensor, "points 2"],
        ellipses: Float32[Tensor, "points 3"],
        opacities: Float32[Tensor, "points 1"],
        colors: Float32[Tensor, "points 3"],
        depths: Float32[Tensor, "points 1"],
        radii: Float32[Tensor, "points 1"],
        remainders: Float32[Tensor, "points 2"],
        background: Float32[Tensor, " 3"],
        size: tuple[int, int],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return color [height, width, 3], alpha and depth [height, width]; the rest as `Projection` gives it."""
        width, height = size
        inputs = [each.detach().numpy() for each in (screen, remainders, ellipses, opacities, colors, depths)]
        paint = background.detach().contiguous().numpy()
        color, alpha, depth = (screen.new_empty(height, width, *more) for more in ((3,), (), ()))
        outputs = [each.numpy() for each in (color, alpha, depth)]
        chosen = _from_front_to_back(radii.numpy()[:, 0], inputs[-1][:, 0])
        places, packed, reaches = _pack(*(each[chosen] for each in inputs))
        lanes = lane_count()
        starts, rows, slots, ends = _list_tiles(places, packed, reaches, size, lanes=lanes)
        bounds = _bounds(starts, lanes)
        kept = np.empty((len(starts) - 1, 3, PIXELS), np.float32)
        listed = places, packed, starts, rows, bounds, paint, _LOG2_MIN_ALPHA, working_numbers(lanes)
        run_lanes(blend, lanes, *listed, *outputs, kept)
        ctx.kept = chosen, places, packed, starts, rows, slots, ends, bounds, paint, kept
        ctx.points = len(screen)
        return color, alpha, depth

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_color: Tensor, by_alpha: Tensor, by_depth: Tensor) -> tuple[Tensor | None, ...]:
        """Return the loss's derivatives by the first five tensors."""
        chosen, places, packed, starts, rows, slots, ends, bounds, paint, kept = ctx.kept
        results = [by_color.new_zeros(ctx.points, width) for width in (2, 3, 1, 3, 1)]
        parts = np.empty((len(rows), 10), np.float32)
        slopes = tuple(each.contiguous().numpy() for each in (by_color, by_alpha, by_depth))
        lanes = len(bounds) - 1
        listed = places, packed, starts, rows, slots, bounds, paint, _LOG2_MIN_ALPHA, working_numbers(lanes)
        run_lanes(blend_back, lanes, *listed, slopes, kept, parts)
        run_lanes(
            _gather, lanes, parts, ends, chosen, packed, np.empty((lanes, 10)), *(each.numpy() for each in results)
        )
        return *results, None, None, None, None


def _bounds(starts: Int64[np.ndarray, " edges"], lanes: int) -> Int64[np.ndarray, " bounds"]:
    """Return where each lane's stretch of tiles begins, and the end: neighbors, for they share many Gaussians."""
    work = starts + _TILE_WORK * np.arange(len(starts))
    bounds = np.searchsorted(work, np.linspace(0, work[-1], lanes + 1))
    bounds[-1] = len(starts) - 1
    return bounds


def _from_front_to_back(
    radii: Float32[np.ndarray, " points"], depths: Float32[np.ndarray, " points"]
) -> Int64[np.ndarray, " seen"]:
    """Return the rows of the Gaussians that are seen, in order of depth, equal ones as they come."""
    seen = np.flatnonzero(radii > 0)
    # The bits of positive floats rise with them; numbers that hold the row too sort faster than rows by their depths.
    keys = (depths[seen].view(np.uint32).astype(np.uint64) << np.uint64(32)) | seen.astype(np.uint64)
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)


def _pack(
    screen: Float32[np.ndarray, "seen 2"],
    remainders: Float32[np.ndarray, "seen 2"],
    ellipses: Float32[np.ndarray, "seen 3"],
    opacities: Float32[np.ndarray, "seen 1"],
    colors: Float32[np.ndarray, "seen 3"],
    depths: Float32[np.ndarray, "seen 1"],
) -> tuple[Float64[np.ndarray, "seen 2"], Float32[np.ndarray, "seen 16"], Float64[np.ndarray, " seen"]]:
    """Return Gaussians' places, packed rows and squared reach.

    A packed row: p, r, s in units of `_SCALE`, log2 of opacity, red, green, blue, depth, half the height in pixels.
    """
    level = np.log2(opacities[:, 0].astype(np.float64))
    reaches = np.maximum(level - math.log2(MIN_ALPHA), 0.0) + _REACH_MARGIN
    packed = np.zeros((len(screen), _WIDTH), np.float32)
    packed[:, :3], packed[:, 4:7] = ellipses * _SCALE, colors
    packed[:, 3], packed[:, 7], packed[:, 8] = level, depths[:, 0], np.sqrt(reaches) / packed[:, 2]
    return screen.astype(np.float64) + remainders, packed, reaches


def _list_tiles(
    places: Float64[np.ndarray, "seen 2"],
    packed: Float32[np.ndarray, "seen 16"],
    reaches: Float64[np.ndarray, " seen"],
    size: tuple[int, int],
    *,
    lanes: int,
) -> tuple[
    Int64[np.ndarray, " edges"], Int32[np.ndarray, " pairs"], Int64[np.ndarray, " pairs"], Int64[np.ndarray, " ends"]
]:
    """Return the tiles' lists for Gaussians in order of depth.

    `starts` [tiles + 1] of each tile's stretch of `rows` [pairs], the Gaussians, and `slots` [pairs], where each pair
    comes if they are counted Gaussian by Gaussian, with `ends` [seen + 1] there.
    """
    tiles = -(-size[0] // SIDE) * -(-size[1] // SIDE)
    counts, ends = np.zeros((lanes, tiles), np.int64), np.zeros(len(places) + 1, np.int64)
    given = places, packed, reaches, size, SIDE
    run_lanes(count_tiles, lanes, *given, counts, ends[1:])
    np.cumsum(ends, out=ends)
    # Tile by tile, and lane by lane within.
    begins = np.concatenate([[0], np.cumsum(counts.T)])
    counts = begins[:-1].reshape(tiles, lanes).T.copy()
    rows, slots = np.empty(ends[-1], np.int32), np.empty(ends[-1], np.int64)
    run_lanes(fill_tiles, lanes, *given, counts, ends, rows, slots)
    return begins[::lanes].copy(), rows, slots, ends


@compiled(error_model="numpy")
@no_type_check
def _gather(
    lane, lanes, parts, ends, chosen, packed, scratch, by_screen, by_ellipses, by_opacities, by_colors, by_depths
):
    """Sum each Gaussian's rows and turn the sums into derivatives; `scratch` [lanes, 10] are numbers to work with."""
    seen, scale, total = len(chosen), float(_SCALE), scratch[lane]
    # The exponent's derivative by u and w is -2 u, -2 w times ln 2 = 1 / (2 scale^2).
    unit = 1.0 / (scale * scale)
    for k in range(lane * seen // lanes, (lane + 1) * seen // lanes):
        for j in range(10):
            total[j] = 0.0
        for slot in range(ends[k], ends[k + 1]):
            for j in range(10):
                total[j] += parts[slot, j]
        i = chosen[k]
        by_screen[i, 0] = unit * total[1] * packed[k, 0]
        by_screen[i, 1] = unit * (total[1] * packed[k, 1] + total[2] * packed[k, 2])
        for j in range(3):
            by_ellipses[i, j] = -unit * scale * total[3 + j]
            by_colors[i, j] = total[6 + j]
        by_opacities[i, 0] = total[0] / 2.0 ** float(packed[k, 3])
        by_depths[i, 0] = total[9]
