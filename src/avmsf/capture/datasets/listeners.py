"""Which of many microphones is the closest to an object, from where they stood."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

SAME_PLACE = 1e-3
"""Meters within which two microphones stood in one place."""


def closest_rows(
    vertices: Int64[np.ndarray, " rows"],
    listeners: Float64[np.ndarray, "rows 3"],
    surface: Float64[np.ndarray, "points 3"],
) -> tuple[list[int], bool]:
    """Return, for each struck vertex in the order of the rows, the row of the microphone closest to the object.

    That is the one whose distance to the nearest point of the surface is the least among the places at which a
    microphone stood for every vertex: what differs between the sounds is then where the object was struck, and not
    from where it was heard. The second value tells whether there are such places; where there are none, each vertex
    has the closest microphone of its own. Of equally close ones the first row counts.
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
