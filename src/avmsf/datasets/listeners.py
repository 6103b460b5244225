"""The microphone closest to an object, from the microphones' positions."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

SAME_PLACE = 1e-3
"""Distance within which two microphone positions are equal, meters."""


def closest_rows(
    vertices: Int64[np.ndarray, " rows"],
    listeners: Float64[np.ndarray, "rows 3"],
    surface: Float64[np.ndarray, "points 3"],
) -> tuple[list[int], bool]:
    """Return, for each impact vertex in the order of the rows, the row of the microphone closest to the object.

    The closest is the one with the smallest distance to the nearest point of the surface among the microphone positions
    that all vertices have in common, so that the sounds differ by the contact only. The second value is whether there
    are such positions; otherwise each vertex has its own closest microphone. Of equally close ones the first row is
    taken.
    """
    tree = cKDTree(surface)
    groups = [np.flatnonzero(vertices == vertex) for vertex in dict.fromkeys(vertices.tolist())]
    first = groups[0]
    matches = np.empty((len(groups), len(first)), dtype=np.int64)
    common = np.ones(len(first), dtype=bool)
    for place, group in enumerate(groups):
        apart, nearest = cKDTree(listeners[group]).query(listeners[first])
        matches[place] = group[nearest]
        common &= apart <= SAME_PLACE
    if not common.any():
        return [int(group[np.argmin(tree.query(listeners[group])[0])]) for group in groups], False
    best = int(np.argmin(np.where(common, tree.query(listeners[first])[0], np.inf)))
    return [int(row) for row in matches[:, best]], True
