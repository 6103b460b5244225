"""Where an object may have been held while it was struck: nodes of its body that do not move.

The object's frame has z upwards. Held may be the part that a table touches, or a straight lower edge in a clamp.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial import ConvexHull, QhullError

from avmsf.errors import SimulationError
from avmsf.fem.elements import SecondOrder

FREE = "free"
FREE_PRIOR = 0.7
"""Probability that an object is free; recordings are meant to be made so. The supports share the rest."""
_HELD_DISTANCE = 0.01
"""Distance from the lowest plane, or from an edge, over the body's size, within which nodes are held."""
_MAX_EDGE_HEIGHT = 0.03
"""Height above the lowest point, over the body's size, up to which an edge is a lower one."""
_MIN_FACE_EXTENT = 0.1
"""Extent of the lowest nodes over the body's size, below which they are a point and no face."""
_MIN_EDGE_EXTENT = 0.3
"""Least length of a straight lower edge over the body's size: the outline of a round base has no such side."""
_MAX_BEND = 0.002
"""Distance over the body's size of a corner from the line between its neighbors, below which that line is straight."""
_MIN_LENGTH_RATIO = 0.5
"""Least length of an edge over the longest one's."""
_MAX_EDGES = 4
"""Edges that are tried at most: a rectangular plate has so many."""
_MAX_HELD_RATIO = 0.4
"""Part of the surface's nodes that may be held: what is left would not ring."""


@dataclass(frozen=True)
class Support:
    """Where a body is held, the same on every mesh of it."""

    name: str
    """In words, such as "held at its lowest face"."""
    edge: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Ends of the lower edge, seen from above, meters; None for the lowest nodes."""

    def nodes(self, mesh: SecondOrder) -> Int[np.ndarray, " nodes"]:
        """Return the rows of the nodes that are held. Raises SimulationError where there are none."""
        outer = mesh.surface[0]
        places, size = mesh.nodes[outer], mesh.solid.size
        heights = places[:, 2] - places[:, 2].min()
        if self.edge is None:
            return outer[heights <= _HELD_DISTANCE * size]
        start, end = np.array(self.edge)
        along = (end - start) / np.linalg.norm(end - start)
        near = (np.abs(_cross(along, places[:, :2] - start)) <= _HELD_DISTANCE * size) & (
            heights <= _MAX_EDGE_HEIGHT * size
        )
        if not near.any():
            raise SimulationError.expected(f"nodes within {1000 * _HELD_DISTANCE * size:.2g} mm", name=self.name)
        return outer[near]


def supports_of(mesh: SecondOrder) -> list[Support]:
    """Return where a body may be held: at its lowest face or point, and along its long straight lower edges."""
    outer = mesh.surface[0]
    places, size = mesh.nodes[outer], mesh.solid.size
    heights = places[:, 2] - places[:, 2].min()
    extent = float(np.linalg.norm(np.ptp(places[heights <= _HELD_DISTANCE * size, :2], axis=0)))
    found = [Support(f"held at its lowest {'point' if extent < _MIN_FACE_EXTENT * size else 'face'}")]
    for number, (start, end) in enumerate(_lower_edges(places[heights <= _MAX_EDGE_HEIGHT * size, :2], size), start=1):
        edge = (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))
        found.append(Support(f"held along lower edge {number}", edge))
    return [each for each in found if len(each.nodes(mesh)) <= _MAX_HELD_RATIO * len(outer)]


def _lower_edges(
    places: Float64[np.ndarray, "places 2"], size: float
) -> list[tuple[Float64[np.ndarray, " 2"], Float64[np.ndarray, " 2"]]]:
    """Return the ends of the long straight sides of an outline seen from below, the longest first."""
    try:
        outline = places[ConvexHull(places).vertices]
    except (QhullError, ValueError):
        # The lowest nodes lie on a line, which the lowest face holds already.
        return []
    # Corners that hardly turn are no corners.
    kept = list(range(len(outline)))
    for row in range(len(outline)):
        if len(kept) > 3 and row in kept:
            place = kept.index(row)
            before, after = outline[kept[place - 1]], outline[kept[(place + 1) % len(kept)]]
            chord = after - before
            if abs(_cross(chord, outline[row] - before)) <= _MAX_BEND * size * np.linalg.norm(chord):
                kept.pop(place)
    corners = outline[kept]
    sides = [(corners[row - 1], corners[row]) for row in range(len(corners))]
    lengths = [float(np.linalg.norm(end - start)) for start, end in sides]
    order = np.argsort(np.negative(lengths), kind="stable")[:_MAX_EDGES]
    least = max(_MIN_EDGE_EXTENT * size, _MIN_LENGTH_RATIO * max(lengths))
    return [sides[row] for row in order if lengths[row] >= least]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors in the plane."""
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
