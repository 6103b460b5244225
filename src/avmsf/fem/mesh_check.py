"""A surface as people have them made fit for walls and tetrahedra, or the reason why it is not."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from jaxtyping import Float64, Int

from avmsf.errors import SimulationError
from avmsf.fem.mesh_smoothing import denoised, roughness
from avmsf.fem.mesh_thinning import thinned
from avmsf.fem.skin import Skin
from avmsf.mesh.surface import Surface

_LIDS = 0.25
"""Part of the closed surface that lids over holes may make up, as `fill` has it."""
_SMALL = 0.02
"""Part of the closed surface that lids over defects of a scan may make up; the openings of vessels are larger."""
_LOOSE = 0.1
"""Part of the area that may lie in loose bits, which a wall leaves out."""
_VESSEL = 0.03
"""Volume that an open surface holds, lids closing it, over its area to the power of 1.5, from which on it has an
inside: that of a dish a tenth as deep as its radius; a hemisphere has .13."""
_HOLLOW = 1.0 / 6.0
"""Thickness of a wall over the mean thickness of what a closed surface holds, beyond which no wall is guessed."""


@dataclass(frozen=True, eq=False)
class CheckedSurface:
    """A surface that has triangles, faces outwards and is smooth."""

    skin: Skin

    @cached_property
    def parts(self) -> Int[np.ndarray, " faces"]:
        """Number of the part that each triangle belongs to, the largest first; those of a part share vertices."""
        return _parts(self.skin)

    @cached_property
    def width(self) -> float:
        """Extent along the second of the axes that the vertices spread along, meters: of a sheet, its narrower side."""
        places = self.skin.points - self.skin.points.mean(axis=0)
        _, axes = np.linalg.eigh(places.T @ places)
        return float(np.sort(np.ptp(places @ axes, axis=0))[1])

    @cached_property
    def lids(self) -> float:
        """Part of the closed surface that lids straight over the holes would make up, 0 to 1."""
        lids = _lids(self.skin)
        area = 0.5 * float(np.linalg.norm(np.cross(lids[:, 1] - lids[:, 0], lids[:, 2] - lids[:, 0]), axis=1).sum())
        return area / (area + float(self.skin.areas.sum()))

    @cached_property
    def mean_thickness(self) -> float | None:
        """Twice the volume over the area, meters: of a thin wall, its thickness; None for a sheet, which holds none."""
        if self.lids > _LIDS:
            return None
        return 2.0 * abs(_held(self.skin)) / float(self.skin.areas.sum())

    def expect_filling(self) -> None:
        """Raise SimulationError where the surface is too open to be filled."""
        if self.lids > _LIDS:
            raise SimulationError(
                f"expected a closed mesh, got {self.skin.open_edges} open edges whose holes are {self.lids:.0%} of the "
                "surface; give a wall thickness, or close the mesh",
                name="mesh",
                value=self.lids,
            )

    def expect_hollow(self, wall: float) -> None:
        """Raise SimulationError where the surface holds too little to be the outside of such a wall."""
        held = self.mean_thickness
        if held is not None and wall > _HOLLOW * held:
            raise SimulationError(
                f"expected a wall of at most {1000 * _HOLLOW * held:.2g} mm in a mesh that is {1000 * held:.2g} mm "
                "thick on average, got a thicker one; use a solid body",
                name="wall",
                value=wall,
            )

    def sheet(self) -> Skin:
        """Return what a wall can follow: the largest part, neighbors facing alike.

        Raises SimulationError where other parts are more than loose bits, and as `Skin.oriented` does.
        """
        areas = np.bincount(self.parts, weights=self.skin.areas)
        if areas[0] < (1.0 - _LOOSE) * areas.sum():
            sizes = ", ".join(f"{10000 * area:.3g}" for area in areas[:4])
            raise SimulationError(
                f"expected a connected mesh, got {len(areas)} parts of {sizes}{', ...' if len(areas) > 4 else ''} cm2; "
                "join them, or give one of them",
                name="parts",
                value=len(areas),
            )
        return Skin.compact(self.skin.points, self.skin.faces[self.parts == 0]).oriented()


def checked(surface: Surface, *, log: Callable[[str], None]) -> CheckedSurface:
    """Return a surface with inverted parts turned and noise taken out, and tell what was done and what is missing.

    A mesh of very many triangles is thinned first. Raises SimulationError for points without triangles, damaged
    triangles and a mesh without area.
    """
    skin, turned = _turned(thinned(_closed(Skin.of(surface)), log=log))
    if turned:
        log(f"{turned} of {len(skin.faces)} triangles of the mesh faced inwards: reversed")
    before = roughness(skin)
    skin, moved = denoised(skin)
    if moved:
        log(
            f"noisy mesh, adjacent triangles differ by {before:.0f} degrees on average: smoothed, vertices moved by "
            f"{1000 * moved:.2g} mm (RMS)"
        )
    result = CheckedSurface(skin)
    if skin.open_edges:
        # No mistake that could be undone: what was seen from inside alone faces inwards, and its wall lies outside.
        if _held(skin) < -_VESSEL * float(skin.areas.sum()) ** 1.5:
            log(
                "open mesh whose triangles face inwards: its wall is taken to be outside; reverse the triangles if the "
                "wall is inside"
            )
        helps = "trying to close the holes" if result.lids <= _LIDS else "give a wall thickness"
        log(f"the mesh has {skin.open_edges} open edges: {helps}")
    return result


def _closed(skin: Skin) -> Skin:
    """Return a skin whose small holes have straight lids; as it is where they are not small, or the lids would cross.

    Holes as large as openings that an object may have stay.
    """
    lids = CheckedSurface(skin).lids
    if not 0.0 < lids <= _SMALL:
        return skin
    corners = np.concatenate([skin.points[skin.faces], _lids(skin)])
    points, rows = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    closed = Skin(points, rows.reshape(-1, 3))
    return closed if closed.crowded_edges <= skin.crowded_edges else skin


def _turned(skin: Skin) -> tuple[Skin, int]:
    """Return a skin whose closed parts face outwards, but for the walls of voids, and how many triangles it turned.

    A part inside the box around another may be a void, which faces inwards; it goes with the part around it.
    """
    number = _parts(skin)
    parts = [Skin.compact(skin.points, skin.faces[number == part]) for part in range(int(number.max()) + 1)]
    lowest, highest = (np.array([edge(part.points, axis=0) for part in parts]) for edge in (np.min, np.max))
    turns = np.zeros(len(parts), dtype=bool)
    for part, each in enumerate(parts):
        around = (lowest[:part] <= lowest[part]).all(axis=1) & (highest[:part] >= highest[part]).all(axis=1)
        inside = np.flatnonzero(around)
        turns[part] = turns[inside[0]] if len(inside) else not each.open_edges and each.volume < 0.0
    turned = turns[number]
    faces = np.where(turned[:, None], skin.faces[:, ::-1], skin.faces)
    return Skin(skin.points, faces), int(turned.sum())


def _parts(skin: Skin) -> Int[np.ndarray, " faces"]:
    """Return the number of the part that each triangle belongs to, the widest first."""
    count = len(skin.points)
    ends = skin.faces[:, [[0, 1], [1, 2]]].reshape(-1, 2)
    joined = scipy.sparse.csr_array((np.ones(len(ends)), ends.T), shape=(count, count))
    found, label = scipy.sparse.csgraph.connected_components(joined, directed=False)
    label = label[skin.faces[:, 0]]
    area = np.bincount(label, weights=skin.areas, minlength=found)
    rank = np.empty(found, dtype=np.int64)
    rank[np.argsort(-area, kind="stable")] = np.arange(found)
    return rank[label]


def _held(skin: Skin) -> float:
    """Return the volume inside a skin whose holes have straight lids, cubic meters; less than 0 where it faces in."""
    lids = _lids(skin)
    return skin.volume + float((np.cross(lids[:, 0], lids[:, 1]) * lids[:, 2]).sum() / 6.0)


def _lids(skin: Skin) -> Float64[np.ndarray, "lids 3 3"]:
    """Return triangles from the open edges to the middle of the rim that they are of, facing as the skin does."""
    rim = skin.rim
    if not len(rim):
        return np.zeros((0, 3, 3))
    used, ends = np.unique(rim, return_inverse=True)
    ends = ends.reshape(-1, 2)
    joined = scipy.sparse.csr_array((np.ones(len(ends)), ends.T), shape=(len(used), len(used)))
    label = scipy.sparse.csgraph.connected_components(joined, directed=False)[1]
    middles = np.stack(
        [np.bincount(label, weights=skin.points[used, axis]) / np.bincount(label) for axis in range(3)], axis=1
    )
    start, end = skin.points[used[ends[:, 0]]], skin.points[used[ends[:, 1]]]
    return np.stack([end, start, middles[label[ends[:, 0]]]], axis=1)
