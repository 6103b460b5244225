"""Distances on a grid from the surface where values change sign, accurate within a cell."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32

from avmsf.compiled import compiled


def distance_from(
    values: Float32[np.ndarray, "x y z"], without: Bool[np.ndarray, "x y z"] | None = None
) -> Float32[np.ndarray, "x y z"]:
    """Return the distance of each cell from the surface where the values are zero, in cells; never negative.

    Along an edge between two cells the values are taken to be linear. Edges whose positive cell is `without` are no
    part of the surface. Infinite where there is no surface.
    """
    nearest = np.full((*values.shape, 3), np.inf, dtype=np.float32)
    distance = np.full(values.shape, np.inf, dtype=np.float32)
    left_out = np.zeros(values.shape, dtype=np.bool_) if without is None else without
    _begin(values, left_out, nearest, distance)
    if np.isfinite(distance).any():
        for _ in range(2):
            _sweep(nearest, distance)
    return distance


@compiled(error_model="numpy")
@no_type_check
def _begin(values, without, nearest, distance):
    """Put the nearest place of the surface next to each cell: the plane through where it crosses the cell's edges."""
    shape = values.shape
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                here = values[i, j, k]
                total = 0.0
                inverse = np.zeros(3)
                for axis in range(3):
                    found, side = 2.0, 0.0
                    for step in (-1, 1):
                        a, b, c = i + step * (axis == 0), j + step * (axis == 1), k + step * (axis == 2)
                        if a < 0 or b < 0 or c < 0 or a >= shape[0] or b >= shape[1] or c >= shape[2]:
                            continue
                        other = values[a, b, c]
                        if (here > 0.0) == (other > 0.0):
                            continue
                        if without[i, j, k] if here > 0.0 else without[a, b, c]:
                            continue
                        reach = min(max(here / (here - other), 1e-3), 1.0)
                        if reach < found:
                            found, side = reach, float(step)
                    if found <= 1.0:
                        inverse[axis] = side / found
                        total += inverse[axis] * inverse[axis]
                if total > 0.0:
                    distance[i, j, k] = 1.0 / np.sqrt(total)
                    nearest[i, j, k, 0] = i + inverse[0] / total
                    nearest[i, j, k, 1] = j + inverse[1] / total
                    nearest[i, j, k, 2] = k + inverse[2] / total


@compiled(error_model="numpy")
@no_type_check
def _sweep(nearest, distance):
    """Hand the nearest places on, in the eight directions along the diagonals."""
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
                        reach = np.sqrt(u * u + v * v + w * w)
                        if reach < best:
                            best = reach
                            distance[i, j, k] = best
                            nearest[i, j, k, 0] = nearest[a, b, c, 0]
                            nearest[i, j, k, 1] = nearest[a, b, c, 1]
                            nearest[i, j, k, 2] = nearest[a, b, c, 2]
