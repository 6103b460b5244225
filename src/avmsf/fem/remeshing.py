"""Triangle meshes as coarse or as fine as elements shall be: edges are halved, and collapsed by their length."""

import heapq

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float64, Int
from trimesh import Trimesh

from avmsf.mesh.surface import Surface

_MIN_CREASE_COSINE = 0.9
"""Of the angle by which a triangle may turn when a mesh is made coarser: creases stay."""
_MIN_FACING_COSINE = 0.4
"""Of the angle between a triangle and the surface's normals at its corners; a box's corner has .58."""
_MAX_SLIVER_RATIO = 0.1
"""Doubled area of a triangle over the square of its longest side, below which it may turn as it likes."""
_MIN_AREA_RATIO = 1e-3
"""The same, below which no triangle may come to lie: its prism would have no volume."""


def mesh_of(points: Float64[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]) -> Trimesh:
    """Return a mesh of triangles on the points that they name, which are all that stay, in their order."""
    used, rows = np.unique(faces, return_inverse=True)
    return Trimesh(points[used], rows.reshape(-1, 3), process=False)


def surface_of(mesh: Trimesh) -> Surface:
    """Return a mesh as a surface, whose vertices are float32."""
    return Surface(torch.from_numpy(np.array(mesh.vertices)).float(), torch.from_numpy(np.array(mesh.faces)))


def boundary_edges(mesh: Trimesh) -> Int[np.ndarray, "edges 2"]:
    """Return the edges with a triangle on one side only: vertices, in the order in which that triangle has them."""
    return mesh.edges[np.bincount(mesh.edges_unique_inverse)[mesh.edges_unique_inverse] == 1]


def adjacency(mesh: Trimesh) -> scipy.sparse.csr_array:
    """Return how many triangles' sides join each pair of vertices."""
    joined = scipy.sparse.csr_array((np.ones(len(mesh.edges)), mesh.edges.T), shape=(len(mesh.vertices),) * 2)
    return joined + joined.T


def even_points(mesh: Trimesh, count: int = 2000) -> Float64[np.ndarray, "samples 3"]:
    """Return points of even density on a mesh, always the same."""
    reached = np.cumsum(mesh.area_faces)
    rows = np.searchsorted(reached, (np.arange(count) + 0.5) / count * reached[-1])
    # In a triangle, places from a sequence that fills the square evenly (Roberts' R2).
    u, v = (np.arange(1, count + 1)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]) % 1.0).T
    weights = np.stack([1.0 - np.sqrt(u), np.sqrt(u) * (1.0 - v), np.sqrt(u) * v], axis=1)
    return np.einsum("pc,pcd->pd", weights, mesh.triangles[rows])


def remeshed(mesh: Trimesh, length: float) -> Trimesh:
    """Return a mesh with edges of about `length` meters, shorter ones only where the surface bends sharply."""
    # In this order, for what is coarsened next to long edges would keep them. A right-angled triangle with sides of
    # 1.2 and .75 lengths has none longer than the 1.5 lengths that coarsening allows, so short edges can go.
    points, faces, count = np.asarray(mesh.vertices), np.asarray(mesh.faces), 0
    while len(faces) > count:
        count = len(faces)
        points, faces = halved(points, faces, 1.2 * length)
    return coarsened(Trimesh(points, faces, process=False), 0.75 * length, turn=_MIN_CREASE_COSINE)


def halved(
    points: Float64[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"], longest: float = 0.0
) -> tuple[Float64[np.ndarray, "more 3"], Int[np.ndarray, "parts 3"]]:
    """Return triangles with each edge that is longer than `longest` meters halved once, the new points last."""
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
    keys, which = np.unique(ends[..., 0] * len(points) + ends[..., 1], return_inverse=True)
    first, second = keys // len(points), keys % len(points)
    split = np.linalg.norm(points[first] - points[second], axis=1) > longest
    middle = np.where(split, len(points) + np.cumsum(split) - 1, -1)[which.reshape(-1, 3)]
    points = np.concatenate([points, 0.5 * (points[first[split]] + points[second[split]])])
    return points, np.concatenate([_split(faces, middle, pattern) for pattern in range(8)])


def _split(faces: np.ndarray, middle: np.ndarray, pattern: int) -> np.ndarray:
    """Return the parts of those faces whose edges 01, 12 and 20 are split as the bits of `pattern` say."""
    bits = ((middle >= 0) * np.array([1, 2, 4])).sum(axis=1)
    chosen = bits == pattern
    (a, b, c), (ab, bc, ca) = faces[chosen].T, middle[chosen].T
    parts = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(b, bc, a), (bc, c, a)],
        4: [(c, ca, b), (ca, a, b)],
        3: [(ab, b, bc), (a, ab, c), (ab, bc, c)],
        6: [(bc, c, ca), (b, bc, a), (bc, ca, a)],
        5: [(ca, a, ab), (c, ca, b), (ca, ab, b)],
        7: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }[pattern]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def coarsened(mesh: Trimesh, shortest: float, *, turn: float) -> Trimesh:
    """Return triangles on some of the vertices with few edges shorter than `shortest` meters.

    The shortest edges go first. One stays where without it a triangle would turn by more than the angle of cosine
    `turn`, or away from the surface's own normals at the vertices, where the rim would move, where the surface would
    touch itself, and where others would grow longer than twice `shortest`.
    """
    collapse = _EdgeCollapse(mesh, shortest=shortest, turn=turn)
    collapse.run()
    return mesh_of(mesh.vertices, np.array(sorted(collapse.faces.values()), dtype=np.int64))


class _EdgeCollapse:
    """Takes out edges by moving one of their ends onto the other, which keeps all vertices on the surface."""

    def __init__(self, mesh: Trimesh, *, shortest: float, turn: float) -> None:
        self._shortest, self._turn = shortest, turn
        self.faces: dict[int, tuple[int, ...]] = {row: tuple(face) for row, face in enumerate(mesh.faces.tolist())}
        self._normals = [tuple(normal) for normal in mesh.vertex_normals.tolist()]
        self._points = [tuple(point) for point in mesh.vertices.tolist()]
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
        """Return whether the surface stays one of much the same form."""
        shared = self._around[gone] & self._around[stays]
        neighbors = self._neighbors(gone)
        # Two vertices that have more neighbors in common than triangles would fold the surface onto itself.
        if len(neighbors & self._neighbors(stays)) != len(shared):
            return False
        for near in neighbors - {stays}:
            length = self._length(stays, near)
            if length > 2.0 * self._shortest and length > self._length(gone, near):
                return False
        on_rim = len(neighbors) != len(self._around[gone])
        if on_rim and not (len(shared) == 1 and self._straight_rim(gone, stays)):
            return False
        for row in self._around[gone] - shared:
            face = self.faces[row]
            before = self._normal(face)
            moved = tuple(stays if corner == gone else corner for corner in face)
            after = self._normal(moved)
            product = sum(p * q for p, q in zip(before, after, strict=True))
            area, later = sum(p * p for p in before) ** 0.5, sum(q * q for q in after) ** 0.5
            # A sliver's normal says little of the form, and slivers shall go.
            sliver = area < _MAX_SLIVER_RATIO * self._longest(face) ** 2
            flat = later < _MIN_AREA_RATIO * self._longest(moved) ** 2
            if flat or (product < self._turn * area * later and not sliver):
                return False
            # Small turns add up; the normals of the surface as it was do not.
            least = min(_MIN_FACING_COSINE * later, self._facing(before, face) * later / (area or 1.0))
            if self._facing(after, moved) < least:
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
