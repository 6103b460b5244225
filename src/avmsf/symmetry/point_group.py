"""Point groups: all symmetries that a bounded object may have together, generated from a few that are roughly known.

The closed subgroups of O(3) are the finite ones (of one axis, or of a tetrahedron, cube or icosahedron) and those with
an axis about which every angle is a symmetry. A surface that every turn about an axis leaves is one of revolution: its
mirror planes contain the axis, and it may have one more across; if any other motion is a symmetry, it is a sphere.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from avmsf.symmetry.motions import Matrices, Motions, Vector, axis_of, reflections, rotations

MAX_ORDER = 12
"""Largest order of an axis that is distinguished from that of any turn."""
GOLDEN_ANGLES = tuple(2 * math.pi * ((step * (math.sqrt(5) - 1) / 2) % 1.0) for step in range(1, 9))
"""Angles that have no small part of a turn in common, which stand for every angle: fractions of the golden section."""
SAME_DISTANCE = 0.055
"""How far apart two motions may carry an object that are one: a plane or axis is off by 6 degrees or .03 diagonals."""
_SAME_COSINE = math.cos(math.radians(12.0))
"""Between an axis and its image under a symmetry: twice 6 degrees."""
_MAX_ELEMENTS = 120
"""Of the largest finite group, that of the icosahedron, whose orders are at most `MAX_ORDER`."""


@dataclass(frozen=True, eq=False)
class PointGroup:
    """Motions about one point, closed under composition."""

    motions: Motions
    """All but the identity. Where axes are continuous, turns about each by golden angles stand for all turns, and a
    reflection across the axis for all that reverse it."""
    continuous: int = 0
    """How many axes are continuous: none, one, or two that stand for those of a sphere."""
    squares: Float[np.ndarray, " motions"] = field(default_factory=lambda: np.zeros(0))
    """Squared error of each motion where the group was fitted, in spacings squared."""

    def rank(self) -> tuple[int | float, float]:
        """Return what is less the larger a fitted group is, and of equal ones the less its error."""
        return -math.inf if self.continuous else -len(self.motions), float(self.squares.mean())

    def contains(self, motions: Motions) -> bool:
        """Return whether all motions are nearly elements."""
        if not self.continuous:
            each = (self.motions.distances(motions[row]) for row in range(len(motions)))
            return all((distances < SAME_DISTANCE).any() for distances in each)
        center, axis = self.motions.center(), axis_of(self.motions.linear[0])
        fixed = np.linalg.norm(motions.apply(center[None, None])[:, 0] - center, axis=1) < SAME_DISTANCE
        cosines = motions.linear @ axis @ axis
        if len(self.motions) > len(GOLDEN_ANGLES):
            cosines = np.abs(cosines)
        return bool((fixed & ((cosines > _SAME_COSINE) | (self.continuous > 1))).all())

    def axes(self) -> list[tuple[Vector, int | None, Int[np.ndarray, " turns"]]]:
        """Return each axis with its order, None if continuous, and the rows of its turns."""
        linear = self.motions.linear
        if self.continuous:
            rows = np.arange(self.continuous * len(GOLDEN_ANGLES)).reshape(self.continuous, -1)
            return [(axis_of(linear[row[0]]), None, row) for row in rows]
        left = np.linalg.det(linear) > 0
        found: list[tuple[Vector, int | None, Int[np.ndarray, " turns"]]] = []
        while left.any():
            axis = axis_of(linear[left.argmax()])
            turns = left & (np.linalg.norm(linear @ axis - axis, axis=1) < 1e-6)
            left &= ~turns
            found.append((axis, int(turns.sum()) + 1, np.flatnonzero(turns)))
        return found

    def planes(self) -> list[tuple[Vector, int]]:
        """Return the normal of each mirror plane that contains no continuous axis, and the row of its reflection."""
        linear = self.motions.linear
        rows = np.flatnonzero((np.linalg.det(linear) < 0) & (np.abs(np.trace(linear, axis1=1, axis2=2) - 1) < 1e-6))
        return [(np.linalg.eigh(linear[row])[1][:, 0], int(row)) for row in rows]


def generate(motions: Motions, axis: Vector | None = None) -> PointGroup | None:
    """Return the group that motions generate together with all turns about an axis; None if there is no such group.

    The motions may be off by some degrees: the group is exact.
    """
    center = motions.center()
    if axis is None:
        elements = _closure(motions.linear)
        return None if elements is None else PointGroup(Motions.about(center, elements[1:]))
    cosines = motions.linear @ axis @ axis
    sphere = bool((np.abs(cosines) < _SAME_COSINE).any())
    elements = rotations(axis, GOLDEN_ANGLES)
    if sphere:
        elements = np.concatenate([elements, rotations(np.linalg.svd(axis[None])[2][1], GOLDEN_ANGLES)])
    elif (cosines < 0).any():
        elements = np.concatenate([elements, reflections(axis[None])])
    return PointGroup(Motions.about(center, elements), 1 + sphere)


def _closure(generators: Matrices) -> Float[np.ndarray, "elements 3 3"] | None:
    """Return the finite group that orthogonal matrices nearly generate, identity first; None if there is none."""
    # Two are one if half the least turn of the largest order leads from one to the other.
    same_trace = 1 + 2 * math.cos(math.pi / MAX_ORDER)
    elements = new = np.eye(3)[None]
    while len(new) and len(elements) <= _MAX_ELEMENTS:
        known = len(elements)
        for product in (new[:, None] @ generators).reshape(-1, 3, 3):
            if np.einsum("nij,ij->n", elements, product).max() < same_trace:
                elements = np.concatenate([elements, product[None]])
        new = elements[known:]
    return None if len(new) else _exact(elements)


def _exact(elements: Matrices) -> Matrices | None:
    """Return the exact group nearest to matrices that nearly are one; None if they are not.

    The mean of the ways to write an element, mean_j M_ij M_j^T for M_i, is nearer to a group, and quadratically so
    (Kazhdan, On epsilon-representations, 1982).
    """
    table = np.einsum("abij,nij->abn", elements[:, None] @ elements, elements).argmax(2)
    if any((np.sort(each, axis=1) != np.arange(len(elements))).any() for each in (table, table.T)):
        return None
    for _ in range(6):
        left, _, right = np.linalg.svd((elements[table] @ elements.transpose(0, 2, 1)).mean(1))
        elements = left @ right
    angles = np.trace(elements[1:], axis1=1, axis2=2)[np.linalg.det(elements[1:]) > 0]
    closed = np.abs(elements[:, None] @ elements - elements[table]).max() < 1e-6
    return elements if closed and (angles < 1 + 2 * math.cos(2 * math.pi / MAX_ORDER) + 1e-6).all() else None
