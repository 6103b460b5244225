"""Which Gaussians touch which tile of the image, from front to back.

A Gaussian is listed for a tile only where the ellipse on which it still counts holds, within the tile's rows, a column
of the tile. The lists are filled in order of depth, so that nothing is sorted but the Gaussians themselves; every lane
of the work counts and then fills its own stretch of that order, so that the outcome does not depend on their number.
"""

import math
import threading
from typing import no_type_check

import numba
import numpy as np

from avmsf.compiled import compiled

KERNELS = threading.Lock()
"""Held while kernels run: where numba has no OpenMP, two threads in its own pool at once end the process."""


@compiled()
@no_type_check
def rank(keys):
    """Return the order that sorts unsigned 32-bit keys upwards, equal ones as they come: least digit first."""
    count = len(keys)
    order, other = np.arange(count).astype(np.int32), np.empty(count, np.int32)
    for shift in (0, 11, 22):
        starts = np.zeros(2049, np.int64)
        for i in range(count):
            starts[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        if starts.max() == count:
            continue
        for digit in range(2048):
            starts[digit + 1] += starts[digit]
        for i in range(count):
            digit = (keys[order[i]] >> np.uint32(shift)) & np.uint32(2047)
            other[starts[digit]] = order[i]
            starts[digit] += 1
        order, other = other, order
    return order


@compiled()
@no_type_check
def _columns(place, packed, reach, top, bottom, width):
    """Return the first and last pixel column of an ellipse between two rows of pixels; none where last < first."""
    p, r, s = float(packed[0]), float(packed[1]), float(packed[2])
    high = math.sqrt(reach) / s
    above, below = max(top + 0.5 - place[1], -high), min(bottom + 0.5 - place[1], high)
    if above > below:
        return 0, -1
    # The ellipse p x + r y = +-sqrt(reach - s^2 y^2) is widest to the right at this height, to the left at minus it.
    summit = -(r / s) * math.sqrt(reach / (r * r + s * s))
    right, left = min(max(summit, above), below), min(max(-summit, above), below)
    rightmost = (math.sqrt(max(reach - s * s * right * right, 0.0)) - r * right) / p
    leftmost = (-math.sqrt(max(reach - s * s * left * left, 0.0)) - r * left) / p
    # Limited before they become whole numbers, which hold less.
    first = math.ceil(min(max(place[0] + leftmost - 0.5, 0.0), float(width)))
    last = math.floor(min(max(place[0] + rightmost - 0.5, -1.0), float(width - 1)))
    return int(first), int(last)


@compiled()
@no_type_check
def _rows(place, packed, reach, height, side):
    """Return the first and last row of tiles that an ellipse may touch."""
    high = math.sqrt(reach) / float(packed[2])
    first = math.ceil(min(max(place[1] - high - 0.5, 0.0), float(height)))
    last = math.floor(min(max(place[1] + high - 0.5, -1.0), float(height - 1)))
    return int(first) // side, (int(last) // side if last >= 0 else -1)


@compiled(parallel=True, error_model="numpy")
@no_type_check
def list_tiles(places, packed, reaches, width, height, side, lanes):
    """Return the tiles' lists for Gaussians in order of depth.

    `places` [seen, 2] pixels float64, `packed` [seen, 16] of which the ellipse's p, r, s come first, `reaches` [seen]
    the squared reach, `side` the tiles' in pixels. Returns `starts` [tiles + 1] of each tile's stretch of `rows`
    [pairs], the Gaussians, and `slots` [pairs], where each pair comes if they are counted Gaussian by Gaussian, with
    `ends` [seen + 1] there.
    """
    seen = len(places)
    across, down = (width + side - 1) // side, (height + side - 1) // side
    counts, ends = np.zeros((lanes, across * down), np.int64), np.zeros(seen + 1, np.int64)
    for lane in numba.prange(lanes):
        for i in range(lane * seen // lanes, (lane + 1) * seen // lanes):
            reach, number = reaches[i], 0
            upper, lower = _rows(places[i], packed[i], reach, height, side)
            for row in range(upper, lower + 1):
                first, last = _columns(
                    places[i], packed[i], reach, row * side, min(row * side + side, height) - 1, width
                )
                if first <= last:
                    for column in range(first // side, last // side + 1):
                        counts[lane, row * across + column] += 1
                        number += 1
            ends[i + 1] = number
    starts = np.zeros(across * down + 1, np.int64)
    for tile in range(across * down):
        total = starts[tile]
        for lane in range(lanes):
            number = counts[lane, tile]
            counts[lane, tile] = total
            total += number
        starts[tile + 1] = total
    for i in range(seen):
        ends[i + 1] += ends[i]
    rows, slots = np.empty(ends[seen], np.int32), np.empty(ends[seen], np.int64)
    for lane in numba.prange(lanes):
        for i in range(lane * seen // lanes, (lane + 1) * seen // lanes):
            reach, slot = reaches[i], ends[i]
            upper, lower = _rows(places[i], packed[i], reach, height, side)
            for row in range(upper, lower + 1):
                first, last = _columns(
                    places[i], packed[i], reach, row * side, min(row * side + side, height) - 1, width
                )
                if first <= last:
                    for column in range(first // side, last // side + 1):
                        at = counts[lane, row * across + column]
                        counts[lane, row * across + column] = at + 1
                        rows[at], slots[at] = i, slot
                        slot += 1
    return starts, rows, slots, ends
