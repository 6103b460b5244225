"""The outer skin of a body, mended and made as coarse or as fine as the elements shall be."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from avmsf.errors import SimulationError
from avmsf.fem.coarsening import coarsen
from avmsf.mesh.surface import Surface

_CREASE = 0.9
"""Cosine of the angle by which a triangle may turn when the skin is made coarser: creases stay."""

_SAME = 2e-6
"""Distance over the body's size up to which vertices are one: text files round, and STL repeats each corner."""


@dataclass(frozen=True, eq=False)
class Skin:
    """Triangles with an area, no two vertices in one place."""

    points: Float64[np.ndarray, "points 3"]
    """Object frame, meters; every one belongs to a triangle."""
    faces: Int[np.ndarray, "faces 3"]
    """Rows of `points`, counter-clockwise from outside."""

    @property
    def size(self) -> float:
        """Diagonal of the box around the skin, meters."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def areas(self) -> Float64[np.ndarray, " faces"]:
        """Square meters."""
        return 0.5 * np.linalg.norm(_doubled(self.points[self.faces]), axis=1)

    @property
    def volume(self) -> float:
        """Cubic meters inside a closed skin."""
        corners = self.points[self.faces]
        return float((np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum() / 6.0)

    @property
    def rim(self) -> Int[np.ndarray, "edges 2"]:
        """Edges with a triangle on one side only: rows of `points`, in the order in which that triangle has them."""
        sides, triangles = self._sides
        return sides[triangles == 1]

    @property
    def open_edges(self) -> int:
        """Edges that have a triangle on one side only."""
        return len(self.rim)

    @property
    def crowded_edges(self) -> int:
        """Edges that more than two triangles share."""
        sides, triangles = self._sides
        return len(np.unique(np.sort(sides[triangles > 2], axis=1), axis=0))

    @property
    def _sides(self) -> tuple[Int[np.ndarray, "sides 2"], Int[np.ndarray, " sides"]]:
        """The three sides of each triangle, and how many triangles share each."""
        sides = self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        # Sorting numbers is ten times as quick as sorting pairs.
        names = sides.min(axis=1) * len(self.points) + sides.max(axis=1)
        _, which, count = np.unique(names, return_inverse=True, return_counts=True)
        return sides, count[which]

    @property
    def normals(self) -> Float64[np.ndarray, "points 3"]:
        """Unit normals at the points: the mean of the triangles around each, weighted by their angles there."""
        corners = self.points[self.faces]
        sides = unit(np.roll(corners, -1, axis=1) - corners)
        angles = np.arccos(np.clip(-(sides * np.roll(sides, 1, axis=1)).sum(axis=-1), -1, 1))
        total = np.zeros_like(self.points)
        np.add.at(total, self.faces, angles[..., None] * unit(_doubled(corners))[:, None])
        return unit(total)

    def spread(self, samples: int = 2000) -> Float64[np.ndarray, "samples 3"]:
        """Return places of even density on the skin."""
        reached = np.cumsum(self.areas)
        rows = np.searchsorted(reached, (np.arange(samples) + 0.5) / samples * reached[-1])
        # In a triangle, places from a sequence that fills the square evenly (Roberts' R2).
        u, v = (np.arange(1, samples + 1)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]) % 1.0).T
        weights = np.stack([1.0 - np.sqrt(u), np.sqrt(u) * (1.0 - v), np.sqrt(u) * v], axis=1)
        return np.einsum("pc,pcd->pd", weights, self.points[self.faces[rows]])

    @classmethod
    def of(cls, surface: Surface) -> "Skin":
        """Return a surface's triangles with vertices in one place made one, without those that have no area.

        Raises SimulationError for points without triangles, coordinates that are not finite, triangles that name
        vertices which are not there, and where no triangle has an area.
        """
        points, faces = surface.vertices.double().numpy(), surface.faces.numpy()
        if not len(faces):
            raise SimulationError(
                f"expected a mesh, got {len(points)} points without triangles; make a mesh of the points",
                name="faces",
                value=0,
            )
        if int(faces.min()) < 0 or int(faces.max()) >= len(points):
            found = int(faces.max()) if int(faces.min()) >= 0 else int(faces.min())
            raise SimulationError(
                f"expected corners of triangles from 0 to {len(points) - 1}, got {found}; export the mesh again",
                name="faces",
                value=found,
            )
        if not np.isfinite(points).all():
            row = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
            value = points[row].tolist()
            raise SimulationError(
                f"vertex {row}: expected finite coordinates in meters, got {value}",
                row=row,
                name="vertices",
                value=value,
            )
        places, rows = np.unique(points[faces.ravel()], axis=0, return_inverse=True)
        pairs = cKDTree(places).query_pairs(
            _SAME * float(np.linalg.norm(np.ptp(places, axis=0))), output_type="ndarray"
        )
        if len(pairs):
            links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
            label = connected_components(links, directed=False)[1]
            places, rows = places[np.unique(label, return_index=True)[1]], label[rows]
        welded = rows.reshape(-1, 3)
        wide = np.linalg.norm(_doubled(places[welded]), axis=1) > 1e-12 * np.linalg.norm(np.ptp(places, axis=0)) ** 2
        if not wide.any():
            raise SimulationError(
                f"expected triangles with an area, got {len(faces)} without; scan the object again",
                name="areas",
                value=0.0,
            )
        return cls.compact(places, welded[wide])

    def oriented(self) -> "Skin":
        """Return the skin without triangles that share an edge with two others or face against their neighbors.

        The widest are kept. Raises SimulationError where more than a twentieth of the area would be lost.
        """
        areas = self.areas
        used: set[tuple[int, int]] = set()
        kept = np.zeros(len(self.faces), dtype=bool)
        for row in np.argsort(-areas, kind="stable"):
            a, b, c = self.faces[row].tolist()
            sides = ((a, b), (b, c), (c, a))
            if used.isdisjoint(sides):
                used.update(sides)
                kept[row] = True
        lost = float(areas[~kept].sum() / areas.sum())
        if lost > 0.05:
            raise SimulationError(
                f"expected triangles counter-clockwise from outside and at most two per edge, got others on {lost:.0%} "
                "of the surface; make the normals of the mesh consistent",
                name="normals",
                value=lost,
            )
        return self.compact(self.points, self.faces[kept])

    def remeshed(self, length: float) -> "Skin":
        """Return the skin with edges of about `length` meters, shorter ones only where the skin bends sharply."""
        # In this order, for what is coarsened next to long edges would keep them. A right-angled triangle with sides of
        # 1.2 and .75 lengths has none longer than the 1.5 lengths that coarsening allows, so short edges can go.
        return self._refined(1.2 * length).coarsened(0.75 * length, turn=_CREASE)

    def _refined(self, longest: float) -> "Skin":
        """Return the skin with all longer edges halved, again and again."""
        points, faces = self.points, self.faces
        while True:
            ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
            keys, which = np.unique(ends[..., 0] * len(points) + ends[..., 1], return_inverse=True)
            first, second = keys // len(points), keys % len(points)
            split = np.linalg.norm(points[first] - points[second], axis=1) > longest
            if not split.any():
                return Skin(points, faces)
            middle = np.where(split, len(points) + np.cumsum(split) - 1, -1)[which.reshape(-1, 3)]
            points = np.concatenate([points, 0.5 * (points[first[split]] + points[second[split]])])
            faces = np.concatenate([_split(faces, middle, pattern) for pattern in range(8)])

    def coarsened(self, shortest: float, *, turn: float) -> "Skin":
        """Return the skin with few edges shorter than `shortest` meters, as `coarsen` takes them out."""
        faces = coarsen(self.points, self.faces, self.normals, shortest=shortest, turn=turn)
        return self.compact(self.points, faces)

    @staticmethod
    def compact(points: Float64[np.ndarray, "points 3"], faces: Int[np.ndarray, "faces 3"]) -> "Skin":
        """Return a skin of triangles on the points that they name, which are all that stay."""
        used, rows = np.unique(faces, return_inverse=True)
        return Skin(points[used], rows.reshape(-1, 3))


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


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length 1 along the last axis; what has no length stays."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def _doubled(corners: Float64[np.ndarray, "faces 3 3"]) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
