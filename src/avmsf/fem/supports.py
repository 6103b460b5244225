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


@dataclass(frozen=True)
class Tolerances:
    """What is held of a body; lengths are over its size."""

    held_distance: float = 0.01  # from the lowest plane, or from an edge, within which nodes are held
    max_edge_height: float = 0.03  # above the lowest point, up to which an edge is a lower one
    min_face_extent: float = 0.1  # of the lowest nodes, below which they are a point and no face
    min_edge_extent: float = 0.3  # of a straight lower edge: the outline of a round base has no such side
    max_bend: float = 0.002  # of a corner from the line between its neighbors, below which that line is straight
    min_length_ratio: float = 0.5  # of an edge over the longest one
    max_edges: int = 4  # that are tried: a rectangular plate has so many
    max_held_ratio: float = 0.4  # part of the surface's nodes that may be held: what is left would not ring


TOLERANCES = Tolerances()


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
            return outer[heights <= TOLERANCES.held_distance * size]
        start, end = np.array(self.edge)
        along = (end - start) / np.linalg.norm(end - start)
        near = (np.abs(_cross(along, places[:, :2] - start)) <= TOLERANCES.held_distance * size) & (
            heights <= TOLERANCES.max_edge_height * size
        )
        if not near.any():
            raise SimulationError.expected(
                f"nodes within {1000 * TOLERANCES.held_distance * size:.2g} mm", name=self.name
            )
        return outer[near]


def supports_of(mesh: SecondOrder) -> list[Support]:
    """Return where a body may be held: at its lowest face or point, and along its long straight lower edges."""
    outer = mesh.surface[0]
    places, size = mesh.nodes[outer], mesh.solid.size
    heights = places[:, 2] - places[:, 2].min()
    extent = float(np.linalg.norm(np.ptp(places[heights <= TOLERANCES.held_distance * size, :2], axis=0)))
    found = [Support(f"held at its lowest {'point' if extent < TOLERANCES.min_face_extent * size else 'face'}")]
    for number, (start, end) in enumerate(
        _lower_edges(places[heights <= TOLERANCES.max_edge_height * size, :2], size), start=1
    ):
        edge = (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))
        found.append(Support(f"held along lower edge {number}", edge))
    return [each for each in found if len(each.nodes(mesh)) <= TOLERANCES.max_held_ratio * len(outer)]


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
            if abs(_cross(chord, outline[row] - before)) <= TOLERANCES.max_bend * size * np.linalg.norm(chord):
                kept.pop(place)
    corners = outline[kept]
    sides = [(corners[row - 1], corners[row]) for row in range(len(corners))]
    lengths = [float(np.linalg.norm(end - start)) for start, end in sides]
    order = np.argsort(np.negative(lengths), kind="stable")[: TOLERANCES.max_edges]
    least = max(TOLERANCES.min_edge_extent * size, TOLERANCES.min_length_ratio * max(lengths))
    return [sides[row] for row in order if lengths[row] >= least]


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors in the plane."""
    return np.asarray(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
