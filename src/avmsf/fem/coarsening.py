"""A surface of triangles made coarser: short edges are taken out one by one, creases and rims stay."""

import heapq

import numpy as np
from jaxtyping import Float64, Int

_FACING = 0.4
"""Least cosine of the angle between a triangle and the surface's normals at its corners; a box's corner has .58."""
_SLIVER = 0.1
"""Doubled area of a triangle over the square of its longest side, below which it may turn as it likes."""
_FLAT = 1e-3
"""The same, below which no triangle may come to lie: its prism would have no volume."""


def coarsen(
    points: Float64[np.ndarray, "points 3"],
    faces: Int[np.ndarray, "faces 3"],
    normals: Float64[np.ndarray, "points 3"],
    *,
    shortest: float,
    turn: float,
) -> Int[np.ndarray, "coarser 3"]:
    """Return triangles on some of the points with few edges shorter than `shortest` meters.

    The shortest edges go first. One stays where without it a triangle would turn by more than the angle of cosine
    `turn`, or away from `normals`, the surface's own at the points, where the rim would move, where the surface would
    touch itself, and where others would grow longer than twice `shortest`.
    """
    collapse = _Collapse(points, faces, normals, shortest=shortest, turn=turn)
    collapse.run()
    return np.array(sorted(collapse.faces.values()), dtype=np.int64)


class _Collapse:
    """Takes out edges by moving one of their ends onto the other, which keeps all vertices on the surface."""

    def __init__(
        self, points: np.ndarray, faces: np.ndarray, normals: np.ndarray, *, shortest: float, turn: float
    ) -> None:
        self._shortest, self._turn = shortest, turn
        self.faces: dict[int, tuple[int, ...]] = {row: tuple(face) for row, face in enumerate(faces.tolist())}
        self._normals = [tuple(normal) for normal in normals.tolist()]
        self._points = [tuple(point) for point in points.tolist()]
        self._around: list[set[int]] = [set() for _ in self._points]
        for row, face in self.faces.items():
            for corner in face:
                self._around[corner].add(row)

    def run(self) -> None:
        """Take out short edges."""
        edges = {_edge(one, other) for face in self.faces.values() for one, other in _pairs(face)}
        heap = [(length, edge) for edge in edges if (length := self._length(*edge)) < self._shortest]
        heapq.heapify(heap)
        while heap:
            one, other = heapq.heappop(heap)[1]
            if not self._around[one] & self._around[other]:
                continue
            if self._may_move(one, other):
                gone, stays = one, other
            elif self._may_move(other, one):
                gone, stays = other, one
            else:
                continue
            self._move(gone, stays)
            for near in sorted(self._neighbors(stays)):
                if (length := self._length(stays, near)) < self._shortest:
                    heapq.heappush(heap, (length, _edge(stays, near)))

    def _may_move(self, gone: int, stays: int) -> bool:
        """Return whether the skin stays a skin of much the same form."""
        shared = self._around[gone] & self._around[stays]
        # Two vertices that have more neighbors in common than triangles would fold the skin onto itself.
        if len(self._neighbors(gone) & self._neighbors(stays)) != len(shared):
            return False
        for near in self._neighbors(gone) - {stays}:
            length = self._length(stays, near)
            if length > 2.0 * self._shortest and length > self._length(gone, near):
                return False
        if self._on_rim(gone) and not (len(shared) == 1 and self._straight_rim(gone, stays)):
            return False
        for row in self._around[gone] - shared:
            face = self.faces[row]
            before = self._normal(face)
            moved = tuple(stays if corner == gone else corner for corner in face)
            after = self._normal(moved)
            alike = sum(p * q for p, q in zip(before, after, strict=True))
            area, later = sum(p * p for p in before) ** 0.5, sum(q * q for q in after) ** 0.5
            # A sliver's normal says little of the form, and slivers shall go.
            sliver = area < _SLIVER * self._longest(face) ** 2
            flat = later < _FLAT * self._longest(moved) ** 2
            if flat or (alike < self._turn * area * later and not sliver):
                return False
            # Small turns add up; the normals of the surface as it was do not.
            if self._facing(after, moved) < min(_FACING * later, self._facing(before, face) * later / (area or 1.0)):
                return False
        return len(self._around[gone]) > len(shared)

    def _move(self, gone: int, stays: int) -> None:
        for row in self._around[gone] & self._around[stays]:
            for corner in self.faces.pop(row):
                self._around[corner].discard(row)
        for row in self._around[gone]:
            self.faces[row] = tuple(stays if corner == gone else corner for corner in self.faces[row])
            self._around[stays].add(row)
        self._around[gone] = set()

    def _facing(self, normal: tuple[float, float, float], face: tuple[int, ...]) -> float:
        """Return the least product of a triangle's normal and the surface's own at its corners."""
        x, y, z = normal
        return min(x * u + y * v + z * w for u, v, w in (self._normals[corner] for corner in face))

    def _neighbors(self, vertex: int) -> set[int]:
        return {corner for row in self._around[vertex] for corner in self.faces[row]} - {vertex}

    def _on_rim(self, vertex: int) -> bool:
        return len(self._neighbors(vertex)) != len(self._around[vertex])

    def _straight_rim(self, gone: int, stays: int) -> bool:
        """Return whether the rim runs on from `stays` over `gone` without a corner."""
        onward = [near for near in self._neighbors(gone) - {stays} if len(self._around[gone] & self._around[near]) == 1]
        if len(onward) != 1:
            return False
        start, middle, end = (self._points[vertex] for vertex in (stays, gone, onward[0]))
        along = sum((q - p) * (r - q) for p, q, r in zip(start, middle, end, strict=True))
        return along >= self._turn * self._length(stays, gone) * self._length(gone, onward[0])

    def _longest(self, face: tuple[int, ...]) -> float:
        return max(self._length(*pair) for pair in _pairs(face))

    def _length(self, one: int, other: int) -> float:
        return float(sum((p - q) ** 2 for p, q in zip(self._points[one], self._points[other], strict=True)) ** 0.5)

    def _normal(self, face: tuple[int, ...]) -> tuple[float, float, float]:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (self._points[corner] for corner in face)
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _pairs(face: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    return (face[0], face[1]), (face[1], face[2]), (face[2], face[0])


def _edge(one: int, other: int) -> tuple[int, int]:
    return (one, other) if one < other else (other, one)
