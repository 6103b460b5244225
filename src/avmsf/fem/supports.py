"""Where bodies are held: elastic foundations under patches of their surface.

A hand, a clamp or a table holds a patch by springs that are spread evenly over its nodes. They act on the rigid motions
of each of its cells alone: on every node for itself they would stiffen the patch too. The load vectors F are these
motions, orthonormal over the nodes of a cell and divided by the root of the number of nodes of the patch, so that k is
the stiffness of the whole patch against a shift, and a body's stiffness matrix becomes K + sum k F F'.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float64, Int
from scipy.spatial import cKDTree

from avmsf.fem.elements import SecondOrder
from avmsf.mesh.points import farthest_points

Place = tuple[float, float, float]
FREE = "free"
FREE_PRIOR = 0.7
"""Probability that an object is free; recordings are meant to be made so. The supports share the rest."""
STIFFNESS_RATIOS = (0.03, 0.003, 0.3, 1000.0)
"""Stiffness of a patch over `HeldModes.stiffness_scale`: about that of the clamps of a measured strip (strip30), at
which supports are compared first, a softer one, a stiffer one, and one that is rigid."""


@dataclass(frozen=True)
class Tolerances:
    """What a patch and its cells are; lengths are over the body's size."""

    held_distance: float = 0.01  # from the extreme plane, within which nodes belong to a patch
    held_radius: float = 0.03  # about a point at which a user says that the object was held: a finger, a foot, a clamp
    max_held_ratio: float = 0.3  # part of the surface's nodes that a patch may hold: what is left would not ring
    cell_extent: float = 0.08  # of a cell: a long patch moves as several rigid ones
    max_cells: int = 8  # of a patch
    rank: float = 1e-3  # singular value of a cell's motions over the largest: nodes on a line cannot tell one


TOLERANCES = Tolerances()


@dataclass(frozen=True)
class Patch:
    """A part of a body's surface where it may be held, the same on every mesh of it: an end, or what is about a point.

    An end has the nodes within 1 % of the body's size of the extreme one, a point those within 3 % of it, and 1 % of
    the nearest one.
    """

    name: str
    """In words, such as "its lowest part"."""
    place: Place
    """Unit vector along which an end lies farthest; or a point on or near the surface, meters."""
    is_end: bool = True

    def nodes(self, mesh: SecondOrder) -> Int[np.ndarray, " nodes"]:
        """Return the rows of the surface's nodes that belong to it."""
        (outer, _), size, place = mesh.surface, mesh.solid.size, np.array(self.place)
        away, reach = np.linalg.norm(mesh.nodes[outer] - place, axis=1), TOLERANCES.held_radius * size
        if self.is_end:
            away, reach = -(mesh.nodes[outer] @ place), -math.inf
        return outer[away <= max(reach, away.min() + TOLERANCES.held_distance * size)]

    def loads(self, mesh: SecondOrder) -> scipy.sparse.csc_array:
        """Return the rigid motions of its cells [3 nodes, loads], as the head of this module scales them."""
        rows = self.nodes(mesh)
        columns = []
        for cell in _cells(mesh.nodes[rows], mesh.solid.size):
            arms = mesh.nodes[rows[cell]] - mesh.nodes[rows[cell]].mean(axis=0)
            turns = np.cross(np.eye(3)[:, None], arms).transpose(1, 2, 0)
            shifts = np.broadcast_to(np.eye(3), (len(cell), 3, 3))
            extent = max(math.sqrt(np.square(arms).sum(1).mean()), np.finfo(float).tiny)
            motions = np.concatenate([shifts, turns / extent], axis=2).reshape(3 * len(cell), 6)
            left, values, _ = np.linalg.svd(motions, full_matrices=False)
            left = left[:, values > TOLERANCES.rank * values[0]] / math.sqrt(len(rows))
            dofs = (3 * rows[cell][:, None] + np.arange(3)).ravel()
            place = np.repeat(dofs, left.shape[1]), np.tile(np.arange(left.shape[1]), len(dofs))
            columns.append(scipy.sparse.csc_array((left.ravel(), place), shape=(3 * len(mesh.nodes), left.shape[1])))
        return scipy.sparse.hstack(columns, format="csc")


@dataclass(frozen=True)
class Support:
    """Patches that are held, all by the same stiffness."""

    patches: tuple[Patch, ...]
    stiffness: float
    """Of each patch, N/m."""

    @property
    def name(self) -> str:
        """Where the body is held, for people."""
        return f"held at {' and '.join(patch.name for patch in self.patches)}"

    def springs(self, mesh: SecondOrder) -> scipy.sparse.csr_array:
        """Return what it adds to a body's stiffness matrix, N/m."""
        loads = scipy.sparse.hstack([patch.loads(mesh) for patch in self.patches], format="csr")
        return (self.stiffness * (loads @ loads.T)).tocsr()


def patches_of(mesh: SecondOrder) -> list[Patch]:
    """Return where a body may be held: at its lowest part (z upwards) and at both ends of the smallest box's axes.

    Faces that are a large part of the surface are none.
    """
    # Takes half a second to import, which objects that are free do without.
    import trimesh

    outer = mesh.surface[0]
    axes = trimesh.bounds.oriented_bounds(mesh.nodes[outer])[0][:3, :3]  # type: ignore[no-untyped-call]
    directions = [np.array([0.0, 0.0, -1.0]), *(sign * axis for axis in axes for sign in (-1.0, 1.0))]
    found: list[Patch] = []
    seen: list[set[int]] = []
    for row, direction in enumerate(directions):
        patch = Patch("", (float(direction[0]), float(direction[1]), float(direction[2])))
        nodes = set(patch.nodes(mesh).tolist())
        known = any(2 * len(nodes & other) > len(nodes | other) for other in seen)
        if known or len(nodes) > TOLERANCES.max_held_ratio * len(outer):
            continue
        x, y, z = 1000.0 * mesh.nodes[sorted(nodes)].mean(axis=0) + 0.0
        name = "its lowest part" if row == 0 else f"its end at ({x:.0f}, {y:.0f}, {z:.0f}) mm"
        found.append(replace(patch, name=name))
        seen.append(nodes)
    return found


def patches_about(points: Sequence[Place]) -> list[Patch]:
    """Return the patches about points on or near the surface, meters."""
    names = ("({:.0f}, {:.0f}, {:.0f}) mm".format(*(1000.0 * each + 0.0 for each in point)) for point in points)
    return [Patch(name, point, is_end=False) for name, point in zip(names, points, strict=True)]


def _cells(places: Float64[np.ndarray, "nodes 3"], size: float) -> list[Int[np.ndarray, " some"]]:
    """Return the rows of places in each cell: those nearest to one of a few points far from each other."""
    extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    count = max(1, min(TOLERANCES.max_cells, math.ceil(extent / (TOLERANCES.cell_extent * size)), len(places)))
    outermost = int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmax())
    centers = places[farthest_points(torch.from_numpy(places), count, start=outermost).numpy()]
    label = cKDTree(centers).query(places)[1]
    return [np.flatnonzero(label == row) for row in range(count)]
