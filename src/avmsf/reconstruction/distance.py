"""Distances from surfaces: on a grid, from where its values change sign, within a cell; and from a convex hull."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import ConvexHull, QhullError

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.errors import SceneError

_DISC_CELLS = 0.7
"""Radius, in cells, of the piece of its tangent plane that stands for the surface around a point next to a cell."""


def distance_from(
    values: Float32[np.ndarray, "x y z"], without: Bool[np.ndarray, "x y z"] | None = None
) -> Float32[np.ndarray, "x y z"]:
    """Return the distance of each cell from the surface where the values are zero, in cells; never negative.

    Along an edge between two cells the values are taken to be linear. Edges whose positive cell is `without` are no
    part of the surface. Infinite where there is no surface.
    """
    nearest = np.zeros((*values.shape, 6), dtype=np.float32)
    distance = np.full(values.shape, np.inf, dtype=np.float32)
    left_out = np.zeros(values.shape, dtype=np.bool_) if without is None else without
    _begin(values, left_out, nearest, distance)
    if np.isfinite(distance).any():
        _sweep(nearest, distance)
    return distance


@compiled(error_model="numpy")
@no_type_check
def _begin(values, without, nearest, distance):
    """Put the nearest point of the surface, and its normal, next to each cell whose edges it crosses."""
    shape = values.shape
    slope = np.zeros(3)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                here = values[i, j, k]
                least, along, side = 2.0, 0, 0.0
                for axis in range(3):
                    for step in (-1, 1):
                        a, b, c = i + step * (axis == 0), j + step * (axis == 1), k + step * (axis == 2)
                        if a < 0 or b < 0 or c < 0 or a >= shape[0] or b >= shape[1] or c >= shape[2]:
                            continue
                        other = values[a, b, c]
                        if (here > 0.0) == (other > 0.0):
                            continue
                        if without[i, j, k] if here > 0.0 else without[a, b, c]:
                            continue
                        reach = here / (here - other)
                        if reach < least:
                            least, along, side = reach, axis, float(step)
                if least > 1.0:
                    continue
                steep = 0.0
                for axis in range(3):
                    x, y, z = axis == 0, axis == 1, axis == 2
                    a, b, c = min(i + x, shape[0] - 1), min(j + y, shape[1] - 1), min(k + z, shape[2] - 1)
                    u, v, w = max(i - x, 0), max(j - y, 0), max(k - z, 0)
                    slope[axis] = (values[a, b, c] - values[u, v, w]) / max(a - u + b - v + c - w, 1)
                    steep += slope[axis] * slope[axis]
                # No nearer than by the slope, and no farther than along the edge.
                if steep > 0.0 and abs(here) < least * np.sqrt(steep):
                    distance[i, j, k] = abs(here) / np.sqrt(steep)
                    for axis in range(3):
                        nearest[i, j, k, 3 + axis] = slope[axis] / np.sqrt(steep)
                    nearest[i, j, k, 0] = i - here * slope[0] / steep
                    nearest[i, j, k, 1] = j - here * slope[1] / steep
                    nearest[i, j, k, 2] = k - here * slope[2] / steep
                else:
                    distance[i, j, k] = least
                    nearest[i, j, k, 0] = i + side * least * (along == 0)
                    nearest[i, j, k, 1] = j + side * least * (along == 1)
                    nearest[i, j, k, 2] = k + side * least * (along == 2)


@compiled(error_model="numpy")
@no_type_check
def _sweep(nearest, distance):
    """Hand the nearest points on to neighbors, in the eight directions along the diagonals."""
    first, second, third = distance.shape
    for turn in range(8):
        x, y, z = turn & 1, (turn >> 1) & 1, (turn >> 2) & 1
        for p in range(first):
            i = first - 1 - p if x else p
            for q in range(second):
                j = second - 1 - q if y else q
                for r in range(third):
                    k = third - 1 - r if z else r
                    best = distance[i, j, k]
                    for axis in range(3):
                        a = i + (2 * x - 1) * (axis == 0)
                        b = j + (2 * y - 1) * (axis == 1)
                        c = k + (2 * z - 1) * (axis == 2)
                        if a < 0 or b < 0 or c < 0 or a >= first or b >= second or c >= third:
                            continue
                        if not distance[a, b, c] < best + 1.0:
                            continue
                        u, v, w = nearest[a, b, c, 0] - i, nearest[a, b, c, 1] - j, nearest[a, b, c, 2] - k
                        above = u * nearest[a, b, c, 3] + v * nearest[a, b, c, 4] + w * nearest[a, b, c, 5]
                        square = u * u + v * v + w * w
                        aside = max(np.sqrt(max(square - above * above, 0.0)) - _DISC_CELLS, 0.0)
                        reach = np.sqrt(above * above + aside * aside) if above != 0.0 else np.sqrt(square)
                        if reach < best:
                            best = reach
                            distance[i, j, k] = best
                            for value in range(6):
                                nearest[i, j, k, value] = nearest[a, b, c, value]


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
