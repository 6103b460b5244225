"""The convex hull of points as a signed distance."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Float64, Int
from scipy.spatial import ConvexHull, QhullError

from avmsf._utils.compiled import compiled, lane_count, run_lanes
from avmsf.errors import SceneError
from avmsf.reconstruction.grid import Grid


def depth_in_convex_hull(
    points: Float64[np.ndarray, "points 3"], grid: Grid, rows: Int[np.ndarray, "cells 3"]
) -> Float32[np.ndarray, " cells"]:
    """Return how far inside the convex hull of points the middles of cells lie, meters, negative outside.

    Raises SceneError for points in one plane.
    """
    try:
        planes = ConvexHull(points).equations
    except QhullError as error:
        raise SceneError(
            f"expected points that span a volume, got {len(points)} in one plane", name="points", value=len(points)
        ) from error
    # Triangles of one flat face share their plane.
    planes = np.unique(np.round(planes, 6), axis=0)
    result = np.full(len(rows), np.inf, dtype=np.float32)
    run_lanes(_inside, lane_count(), planes, grid.lowest, grid.spacing, rows, result)
    return result


@compiled(error_model="numpy")
@no_type_check
def _inside(lane, lanes, planes, lowest, spacing, rows, result):
    count = rows.shape[0]
    for cell in range(lane * count // lanes, (lane + 1) * count // lanes):
        x = lowest[0] + spacing * rows[cell, 0]
        y = lowest[1] + spacing * rows[cell, 1]
        z = lowest[2] + spacing * rows[cell, 2]
        least = np.inf
        for plane in range(planes.shape[0]):
            least = min(least, -(planes[plane, 0] * x + planes[plane, 1] * y + planes[plane, 2] * z + planes[plane, 3]))
        result[cell] = least
