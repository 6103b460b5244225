"""The innermost loops: one Gaussian on the 64 pixels of one tile, forward and backward.

Gaussian k covers alpha_k of a pixel, of whose light T_k = prod_{j<k} (1 - alpha_j) is left in front of it:

    color = sum_k T_k alpha_k color_k + T_end background.

With the loss L and g_k = dL/dcolor . color_k (depth is one more channel), the derivative that `blend_back` computes is

    dL/dalpha_k = T_k g_k - B_k / (1 - alpha_k),  B_k = sum_{j>k} T_j alpha_j g_j + T_end dL/dT_end,

from back to front, so that B_k is a running sum and T_k = T_{k+1} / (1 - alpha_k).

They are written so that the compiler turns them into vectors of pixels: no branches, no views of arrays, a polynomial
for the exponential, and only those pairs of rows that the ellipse reaches.
"""

import math
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float32
from numba.core import types
from numba.extending import intrinsic

from avmsf._utils.compiled import compiled

SIDE = 8
"""Width and height of a tile, pixels: its 64 pixels fill the registers, and few of them lie outside an ellipse."""
PIXELS = SIDE * SIDE
_MAX_ALPHA = np.float32(0.999)
"""No Gaussian covers more than this of a pixel, so that 1 - alpha can be divided by (gsplat)."""
_MIN_TRANSMITTANCE = np.float32(1e-4)
"""A Gaussian that would leave this little of what lies behind is not drawn, nor any behind it (3DGS)."""
_MIN_EXPONENT = np.float32(-8.0)
_ONE, _ZERO, _NONE = np.float32(1.0), np.float32(0.0), np.float32(-1.0)
_ROW, _LIVE, _REST, _RED, _GREEN, _BLUE, _AWAY, _NUMBER = (np.uint64(k * PIXELS) for k in range(1, 9))
"""Where a tile's working numbers begin; unsigned, so that no check for a negative index keeps loops from vectors."""
_FAST = {"contract", "reassoc", "nsz"}
"""Sums may be taken in any order; numbers that are not finite stay what they are."""


@intrinsic
@no_type_check
def _power(typing: Any, exponent: Any) -> Any:
    """Return 2 to a whole number from -126 to 127: its bits, shifted to the exponent's place in a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (number,) = arguments
        biased = builder.add(number, context.get_constant(types.int32, 127))
        bits = builder.shl(biased, context.get_constant(types.int32, 23))
        return builder.bitcast(bits, context.get_value_type(types.float32))

    return types.float32(types.int32), generate


@compiled(inline="always")
@no_type_check
def _exponential(x):
    """Return 2 to a float32 number from -8 to 0, within 3e-7 of its value: a polynomial (Remez) about whole numbers."""
    # Half is taken off because conversion rounds towards zero.
    whole = np.int32(x - np.float32(0.5))
    part = x - np.float32(whole)
    value = np.float32(0.0013276471959296377) * part + np.float32(0.009675541502705673)
    value = value * part + np.float32(0.05550713275067311)
    value = value * part + np.float32(0.24022119720750015)
    value = value * part + np.float32(0.6931469670628825)
    value = value * part + np.float32(1.0000000716553017)
    return value * _power(whole)


def working_numbers(lanes: int) -> Float32[np.ndarray, "lanes numbers"]:
    """Return each lane's numbers for a tile, nine for each of its pixels, with the pixels' places in the first two."""
    numbers = np.empty((lanes, 9, SIDE, SIDE), np.float32)
    numbers[:, 0], numbers[:, 1] = np.arange(SIDE) + 0.5, np.arange(SIDE)[:, None] + 0.5
    return numbers.reshape(lanes, 9 * PIXELS)


@compiled()
@no_type_check
def _stretch(down, high):
    """Return the first and the last but one of the tile's four double rows that an ellipse's height reaches."""
    first = min(max(math.ceil(down - high - 0.5), 0.0), 8.0)
    last = min(max(math.floor(down + high - 0.5), -1.0), 7.0)
    return int(first) // 2, (int(last) + 2) // 2


@compiled(error_model="numpy", fastmath=_FAST)
@no_type_check
def _cover(scratch, packed, row, middle, center, first, last, number, min_level):
    """Draw one Gaussian on a tile's pixels in the double rows from `first` to before `last`.

    `scratch` goes on with what is left for the next Gaussian, what is left in the end, red, green, blue, depth, and the
    number of the last that was drawn.
    """
    p_x, r_y, s_y, peak = packed[row, 0], packed[row, 1], packed[row, 2], packed[row, 3]
    red, green, blue, away = packed[row, 4], packed[row, 5], packed[row, 6], packed[row, 7]
    for p in range(np.uint64(16 * first), np.uint64(16 * last)):
        x, y = scratch[p] - middle, scratch[_ROW + p] - center
        u, w = p_x * x + r_y * y, s_y * y
        power = peak - (u * u + w * w)
        covered = min(_exponential(max(power, _MIN_EXPONENT)), _MAX_ALPHA)
        before, rest, previous = scratch[_LIVE + p], scratch[_REST + p], scratch[_NUMBER + p]
        after = before * (_ONE - covered)
        counts = power >= min_level
        drawn = counts & (after > _MIN_TRANSMITTANCE)
        weight = covered * before if drawn else _ZERO
        left = after if drawn else _ZERO
        scratch[_LIVE + p] = left if counts else before
        scratch[_REST + p] = after if drawn else rest
        scratch[_RED + p] += weight * red
        scratch[_GREEN + p] += weight * green
        scratch[_BLUE + p] += weight * blue
        scratch[_AWAY + p] += weight * away
        scratch[_NUMBER + p] = number if drawn else previous


@compiled(error_model="numpy", fastmath=_FAST)
@no_type_check
def blend(lane, lanes, places, packed, starts, rows, bounds, paint, min_level, numbers, color, alpha, depth, kept):
    """Blend the tiles' lists into `color`, `alpha` and `depth`, and keep what the way back needs of every tile.

    Each lane takes the tiles from one of the `bounds` to the next. `kept` [tiles, 3, 64] gets what is left of each
    pixel, the place in the list of the last Gaussian drawn, and the mean depth. Below `min_level`, the binary logarithm
    of what it covers, a Gaussian does not count. `numbers` are those of `working_numbers`.
    """
    height, width = alpha.shape
    across = (width + SIDE - 1) // SIDE
    scratch = numbers[lane]
    for tile in range(bounds[lane], bounds[lane + 1]):
        left, top = (tile % across) * SIDE, (tile // across) * SIDE
        for p in range(PIXELS):
            inside = left + p % SIDE < width and top + p // SIDE < height
            # Nothing is left where the image ends, so that those pixels keep no other waiting.
            scratch[2 * PIXELS + p] = _ONE if inside else _ZERO
            scratch[3 * PIXELS + p] = _ONE
            scratch[8 * PIXELS + p] = _NONE
        for p in range(4 * PIXELS, 8 * PIXELS):
            scratch[p] = _ZERO
        for k in range(starts[tile + 1] - starts[tile]):
            row = rows[starts[tile] + k]
            middle, center = places[row, 0] - left, places[row, 1] - top
            first, last = _stretch(center, packed[row, 8])
            _cover(scratch, packed, row, np.float32(middle), np.float32(center), first, last, np.float32(k), min_level)
            if k % 4 == 3:
                most = _ZERO
                for p in range(PIXELS):
                    most = max(most, scratch[2 * PIXELS + p])
                if most == _ZERO:
                    break
        for p in range(PIXELS):
            rest = scratch[3 * PIXELS + p]
            mean = scratch[7 * PIXELS + p] / (_ONE - rest) if rest < _ONE else _ZERO
            kept[tile, 0, p], kept[tile, 1, p], kept[tile, 2, p] = rest, scratch[8 * PIXELS + p], mean
            i, j = top + p // SIDE, left + p % SIDE
            if i < height and j < width:
                color[i, j, 0] = scratch[4 * PIXELS + p] + rest * paint[0]
                color[i, j, 1] = scratch[5 * PIXELS + p] + rest * paint[1]
                color[i, j, 2] = scratch[6 * PIXELS + p] + rest * paint[2]
                alpha[i, j], depth[i, j] = _ONE - rest, mean


@compiled(error_model="numpy", fastmath=_FAST)
@no_type_check
def _uncover(scratch, packed, row, middle, center, first, last, number, min_level, parts, slot):
    """Take one Gaussian off a tile's pixels again and write ten sums over these pixels into `parts[slot]`.

    With h = alpha dL/dalpha, the pixel's offset (x, y) from the center and the same in standard deviations (u, w), they
    are those of h, h u, h w, h u x, h u y, h w y, and the derivatives by red, green, blue and depth. `scratch` goes on
    with T, B, the loss's derivatives by red, green, blue and the sum of depths, and the number of the last that was
    drawn.
    """
    p_x, r_y, s_y, peak = packed[row, 0], packed[row, 1], packed[row, 2], packed[row, 3]
    red, green, blue, away = packed[row, 4], packed[row, 5], packed[row, 6], packed[row, 7]
    sum_0, sum_u, sum_w, sum_ux, sum_uy, sum_wy = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    sum_red, sum_green, sum_blue, sum_away = _ZERO, _ZERO, _ZERO, _ZERO
    for p in range(np.uint64(16 * first), np.uint64(16 * last)):
        x, y = scratch[p] - middle, scratch[_ROW + p] - center
        u, w = p_x * x + r_y * y, s_y * y
        power = peak - (u * u + w * w)
        raw = _exponential(max(power, _MIN_EXPONENT))
        drawn = (power >= min_level) & (number <= scratch[_NUMBER + p])
        covered = min(raw, _MAX_ALPHA) if drawn else _ZERO
        passed = _ONE / (_ONE - covered)
        before, behind = scratch[_LIVE + p] * passed, scratch[_REST + p]
        by_red, by_green = scratch[_RED + p], scratch[_GREEN + p]
        by_blue, by_sum = scratch[_BLUE + p], scratch[_AWAY + p]
        gain = by_red * red + by_green * green + by_blue * blue + by_sum * away
        weight = covered * before
        slope = covered * (before * gain - behind * passed)
        # Where alpha is held at its largest nothing moves it.
        by_power = slope if raw <= _MAX_ALPHA else _ZERO
        scratch[_LIVE + p] = before
        scratch[_REST + p] = behind + weight * gain
        by_u, by_w = by_power * u, by_power * w
        sum_0 += by_power
        sum_u += by_u
        sum_w += by_w
        sum_ux += by_u * x
        sum_uy += by_u * y
        sum_wy += by_w * y
        sum_red += weight * by_red
        sum_green += weight * by_green
        sum_blue += weight * by_blue
        sum_away += weight * by_sum
    parts[slot, 0], parts[slot, 1], parts[slot, 2], parts[slot, 3] = sum_0, sum_u, sum_w, sum_ux
    parts[slot, 4], parts[slot, 5], parts[slot, 6], parts[slot, 7] = sum_uy, sum_wy, sum_red, sum_green
    parts[slot, 8], parts[slot, 9] = sum_blue, sum_away


@compiled(error_model="numpy", fastmath=_FAST)
@no_type_check
def blend_back(
    lane, lanes, places, packed, starts, rows, slots, bounds, paint, min_level, numbers, slopes, kept, parts
):
    """Write for each pair of tile and Gaussian the sums that `_uncover` makes into its row of `parts`.

    `slopes` are the loss's derivatives by color, alpha and depth.
    """
    by_color, by_alpha, by_depth = slopes
    height, width = by_alpha.shape
    across = (width + SIDE - 1) // SIDE
    scratch = numbers[lane]
    for tile in range(bounds[lane], bounds[lane + 1]):
        if starts[tile + 1] == starts[tile]:
            continue
        left, top = (tile % across) * SIDE, (tile // across) * SIDE
        most = _NONE
        for p in range(PIXELS):
            i, j = top + p // SIDE, left + p % SIDE
            inside = i < height and j < width
            rest, last, mean = kept[tile, 0, p], kept[tile, 1, p], kept[tile, 2, p]
            by_red, by_green = (by_color[i, j, 0], by_color[i, j, 1]) if inside else (_ZERO, _ZERO)
            by_blue, by_rest = (by_color[i, j, 2], -by_alpha[i, j]) if inside else (_ZERO, _ZERO)
            by_sum = by_depth[i, j] / (_ONE - rest) if inside and rest < _ONE else _ZERO
            by_rest += by_sum * mean + by_red * paint[0] + by_green * paint[1] + by_blue * paint[2]
            scratch[2 * PIXELS + p], scratch[3 * PIXELS + p] = rest, rest * by_rest
            scratch[4 * PIXELS + p], scratch[5 * PIXELS + p] = by_red, by_green
            scratch[6 * PIXELS + p], scratch[7 * PIXELS + p] = by_blue, by_sum
            scratch[8 * PIXELS + p] = last
            most = max(most, last)
        reached = int(most) + 1
        for k in range(reached, starts[tile + 1] - starts[tile]):
            for j in range(10):
                parts[slots[starts[tile] + k], j] = _ZERO
        for k in range(reached - 1, -1, -1):
            row, slot = rows[starts[tile] + k], slots[starts[tile] + k]
            middle, center = np.float32(places[row, 0] - left), np.float32(places[row, 1] - top)
            first, last = _stretch(places[row, 1] - top, packed[row, 8])
            _uncover(scratch, packed, row, middle, center, first, last, np.float32(k), min_level, parts, slot)
