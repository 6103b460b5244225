"""Which Gaussians touch which tile of the image, from front to back.

A Gaussian is listed for a tile only where the ellipse on which it still counts holds, within the tile's rows, a column
of the tile. The lists are filled in order of depth, so that nothing is sorted but the Gaussians themselves; every lane
of the work counts and then fills its own stretch of that order, so that the outcome does not depend on their number.
"""

import math
from typing import no_type_check

from avmsf._utils.compiled import compiled


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


@compiled(error_model="numpy")
@no_type_check
def count_tiles(lane, lanes, places, packed, reaches, size, side, counts, numbers):
    """Add to `counts` [lanes, tiles] how many Gaussians of each lane touch each tile; write each one's number of tiles.

    Gaussians come in order of depth: `places` [seen, 2] pixels float64, `packed` [seen, 16] of which the ellipse's p,
    r, s come first, `reaches` [seen] the squared reach. `size` is the image's width and height, `side` the tiles' own,
    pixels. Each lane takes its own stretch of the Gaussians.
    """
    seen, width, height = len(places), size[0], size[1]
    across = (width + side - 1) // side
    for i in range(lane * seen // lanes, (lane + 1) * seen // lanes):
        number = 0
        upper, lower = _rows(places[i], packed[i], reaches[i], height, side)
        for row in range(upper, lower + 1):
            bottom = min(row * side + side, height) - 1
            first, last = _columns(places[i], packed[i], reaches[i], row * side, bottom, width)
            if first <= last:
                for column in range(first // side, last // side + 1):
                    counts[lane, row * across + column] += 1
                    number += 1
        numbers[i] = number


@compiled(error_model="numpy")
@no_type_check
def fill_tiles(lane, lanes, places, packed, reaches, size, side, counts, begins, rows, slots):
    """Write each tile's Gaussians into its stretch of `rows` [pairs], and each pair's place Gaussian by Gaussian.

    As `count_tiles`, but `counts` says where each lane's part of each tile's stretch begins, and is used up; `begins`
    where each Gaussian's own pairs begin, which `slots` [pairs] tells of.
    """
    seen, width, height = len(places), size[0], size[1]
    across = (width + side - 1) // side
    for i in range(lane * seen // lanes, (lane + 1) * seen // lanes):
        slot = begins[i]
        upper, lower = _rows(places[i], packed[i], reaches[i], height, side)
        for row in range(upper, lower + 1):
            bottom = min(row * side + side, height) - 1
            first, last = _columns(places[i], packed[i], reaches[i], row * side, bottom, width)
            if first <= last:
                for column in range(first // side, last // side + 1):
                    at = counts[lane, row * across + column]
                    counts[lane, row * across + column] = at + 1
                    rows[at], slots[at] = i, slot
                    slot += 1
