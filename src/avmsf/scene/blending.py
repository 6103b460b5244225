"""From ellipses in the image to pixels: the second half of rasterising, with its gradient.

Every pixel takes the Gaussians of its tile from front to back. One that covers alpha of it gives alpha T of its colour
and leaves T (1 - alpha) of what lies behind, until less than 1e-4 is left (3DGS). The gradient takes them from back to
front, dividing T by 1 - alpha again, and writes one row for each pair of tile and Gaussian; these are summed at the end
in an order that does not depend on the number of threads.
"""

import math
from typing import Any, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from avmsf.compiled import compiled
from avmsf.scene.ellipses import FAINTEST
from avmsf.scene.pixels import PIXELS, SIDE, blend, blend_back
from avmsf.scene.tiles import KERNELS, list_tiles, rank

_WIDTH = 16
"""Numbers a Gaussian's packed row holds: one cache line."""
_SCALE = np.float32(np.sqrt(0.5 / np.log(2.0)))
"""Takes standard deviations to such units that a Gaussian is 2 to minus their square."""


_SLACK = 1e-4
"""By how much the squared reach is widened, so that rounding of the ellipse's edge loses no pixel that counts."""
_FAINT = np.float32(np.log2(FAINTEST))


_TILE_WORK = 8
"""A tile itself takes about as long as this many Gaussians on it."""


class Blending(torch.autograd.Function):
    """Colour, coverage and depth of every pixel from the Gaussians' ellipses."""

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
        """Return colour [height, width, 3], alpha and depth [height, width]; the rest as `Projection` gives it."""
        width, height = size
        inputs = [each.detach().numpy() for each in (screen, remainders, ellipses, opacities, colors, depths)]
        paint = background.detach().contiguous().numpy()
        color, alpha, depth = (screen.new_empty(height, width, *more) for more in ((3,), (), ()))
        outputs = [each.numpy() for each in (color, alpha, depth)]
        lanes = numba.get_num_threads()
        with KERNELS:
            seen = np.flatnonzero(radii.numpy()[:, 0] > 0)
            # The bits of positive floats rise with them.
            chosen = seen[rank(depths.detach().numpy()[seen, 0].view(np.uint32))]
            places, packed, reaches = _pack(chosen, FAINTEST, *inputs)
            starts, rows, slots, ends = list_tiles(places, packed, reaches, width, height, SIDE, lanes)
            bounds = _bounds(starts, lanes)
            kept = np.empty((len(starts) - 1, 3, PIXELS), np.float32)
            blend(places, packed, starts, rows, bounds, paint, _FAINT, *outputs, kept)
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
        slopes = [each.contiguous().numpy() for each in (by_color, by_alpha, by_depth)]
        lanes = numba.get_num_threads()
        with KERNELS:
            blend_back(places, packed, starts, rows, slots, bounds, paint, _FAINT, *slopes, kept, parts)
            _gather(parts, ends, chosen, packed, lanes, *(each.numpy() for each in results))
        return *results, None, None, None, None


def _bounds(starts: Int64[np.ndarray, " edges"], lanes: int) -> Int64[np.ndarray, " bounds"]:
    """Return where each lane's stretch of tiles begins, and the end: neighbours, for they share many Gaussians."""
    work = starts + _TILE_WORK * np.arange(len(starts))
    bounds = np.searchsorted(work, np.linspace(0, work[-1], lanes + 1))
    bounds[-1] = len(starts) - 1
    return bounds


@compiled(error_model="numpy")
@no_type_check
def _pack(chosen, faintest, screen, remainders, ellipses, opacities, colors, depths):
    """Return the chosen Gaussians' places in float64, packed rows and squared reach.

    A packed row: p, r, s in units of `_SCALE`, log2 of opacity, red, green, blue, depth, half the height in pixels.
    """
    places, reaches = np.empty((len(chosen), 2)), np.empty(len(chosen))
    packed = np.zeros((len(chosen), _WIDTH), np.float32)
    for k in range(len(chosen)):
        i = chosen[k]
        places[k, 0] = float(screen[i, 0]) + float(remainders[i, 0])
        places[k, 1] = float(screen[i, 1]) + float(remainders[i, 1])
        opacity = float(opacities[i, 0])
        reaches[k] = max(math.log2(opacity / faintest), 0.0) + _SLACK
        for j in range(3):
            packed[k, j] = ellipses[i, j] * _SCALE
            packed[k, 4 + j] = colors[i, j]
        packed[k, 3], packed[k, 7] = math.log2(opacity), depths[i, 0]
        packed[k, 8] = math.sqrt(reaches[k]) / float(packed[k, 2])
    return places, packed, reaches


@compiled(parallel=True, error_model="numpy")
@no_type_check
def _gather(parts, ends, chosen, packed, lanes, by_screen, by_ellipses, by_opacities, by_colors, by_depths):
    """Sum each Gaussian's rows and turn the sums into derivatives."""
    seen, scale = len(chosen), float(_SCALE)
    # The exponent's derivative by u and w is -2 u, -2 w times ln 2 = 1 / (2 scale^2).
    unit = 1.0 / (scale * scale)
    for lane in numba.prange(lanes):
        total = np.empty(10)
        for k in range(lane * seen // lanes, (lane + 1) * seen // lanes):
            total[:] = 0.0
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
