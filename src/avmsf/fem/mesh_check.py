"""A surface as people have them made fit for walls and tetrahedra, or the reason why it is not."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import fast_simplification
import numpy as np
import scipy.optimize
import scipy.sparse
from jaxtyping import Float64, Int
from scipy.sparse.linalg import splu

from avmsf.errors import SimulationError
from avmsf.fem.skin import Skin, components
from avmsf.fem.solid import several_parts
from avmsf.mesh.closest_point import ClosestPoints
from avmsf.mesh.surface import Surface

ROUGH = 20.0
"""Degrees that neighboring triangles differ by on the mean, in a mesh that is likelier noisy than finely shaped."""
_FINE = 0.06
"""Mean edge over the body's size from which on a mesh is too coarse to tell noise from form: a box turns by 60."""
_PROBES = 8
"""Random vectors that estimate the number of degrees of freedom left, within a per cent for thousands of vertices."""
_WEAKEST, _STRONGEST = -3.0, 5.0
"""Decimal logarithms of the strengths to choose from."""
_KEPT = 0.8
"""Part of the vertices' degrees of freedom that a mesh without noise would keep."""


def roughness(skin: Skin) -> float:
    """Return the mean angle between the normals of neighboring triangles, degrees; 0 for a mesh of few long edges."""
    one, other, ends = skin.neighbors
    lengths = np.linalg.norm(skin.points[ends[:, 0]] - skin.points[ends[:, 1]], axis=1)
    if not len(ends) or lengths.mean() > _FINE * skin.size:
        return 0.0
    normals = skin.face_normals
    angles = np.arccos(np.clip((normals[one] * normals[other]).sum(axis=1), -1.0, 1.0))
    return math.degrees(float(angles.mean()))


def denoised(skin: Skin) -> tuple[Skin, float]:
    """Return a noisy mesh without its noise, and how far that moved the vertices, meters, root mean square.

    A scan's noise is drawn afresh at each vertex, while a surface runs on from one vertex to the next. Of the surfaces
    that balance closeness to the vertices against bending, (1 + strength L L) places = vertices with L the mean
    difference from the neighbors, generalized cross-validation takes the one that predicts left-out vertices best.
    A mesh that is not rough, or whose vertices predict each other no better when smoothed, comes back as it is, with
    0. The volume of a closed one stays.
    """
    if roughness(skin) < ROUGH:
        return skin, 0.0
    bending = _bending(skin)
    probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(skin.points), _PROBES))
    identity = scipy.sparse.eye_array(len(skin.points), format="csc")

    def smooth(exponent: float) -> tuple[Float64[np.ndarray, "points 3"], float]:
        solve = splu(
            identity + 10.0**exponent * bending, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
        ).solve
        return solve(skin.points), float((probes * solve(probes)).sum(axis=0).mean() / len(probes))

    def error(exponent: float) -> float:
        points, kept = smooth(exponent)
        return math.log(float(((points - skin.points) ** 2).mean()) / (1.0 - kept) ** 2)

    found = scipy.optimize.minimize_scalar(error, bounds=(_WEAKEST, _STRONGEST), options={"xatol": 0.05})
    points, kept = smooth(float(found.x))
    if kept > _KEPT:
        return skin, 0.0
    smoothed = _as_large(Skin(points, skin.faces), skin)
    return smoothed, float(np.sqrt(((smoothed.points - skin.points) ** 2).sum(axis=1).mean()))


def averaged(skin: Skin, rounds: int) -> Skin:
    """Return a skin whose points were moved, so many times, to the mean of themselves and their neighbors.

    The volume of a closed one stays.
    """
    step = _averaging(_joined(skin) + scipy.sparse.eye_array(len(skin.points)))
    points = skin.points
    for _ in range(rounds):
        points = step @ points
    return _as_large(Skin(points, skin.faces), skin)


def _bending(skin: Skin) -> scipy.sparse.csc_array:
    """Return the squared difference of each point from the mean of its neighbors, as a matrix."""
    difference = scipy.sparse.eye_array(len(skin.points)) - _averaging(_joined(skin))
    return (difference.T @ difference).tocsc()


def _averaging(joined: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Return what takes the mean over the points that each is joined to."""
    return scipy.sparse.diags_array(1.0 / joined.sum(axis=1)) @ joined


def _joined(skin: Skin) -> scipy.sparse.csr_array:
    """Return 1 for points that share an edge."""
    joined = skin.adjacency
    joined.data[:] = 1.0
    return joined


def _as_large(smoothed: Skin, skin: Skin) -> Skin:
    """Return a closed skin grown evenly from its middle to the volume it had, for smoothing shrinks what is round."""
    if skin.open_edges or smoothed.volume == 0.0 or skin.volume / smoothed.volume <= 0.0:
        return smoothed
    middle = smoothed.points.mean(axis=0)
    factor = float(np.cbrt(skin.volume / smoothed.volume))
    return Skin(middle + factor * (smoothed.points - middle), skin.faces)


MOST = 60_000
"""Triangles beyond which a mesh is simplified even where that changes its form."""
ENOUGH = 16_000
"""Triangles beyond which it is simplified as far as its form stays: finite-element models have some thousand on their
surface."""
_TOLERANCE = 0.01
"""Root mean square distance of the simplified mesh from the given one, over the mean thickness, twice the volume over
the area. Frequencies of a thin wall go with its thickness. Chosen on a twisted blade."""
_ROUNDS = 4
"""Averages taken of a noisy mesh over the thinning, so that they reach little farther than an edge that stays."""


def thinned(skin: Skin, *, log: Callable[[str], None]) -> Skin:
    """Return a skin of at most `MOST` triangles, fewer within the tolerance, and tell what was done to a larger one.

    More are left where fewer would open a seam or share an edge among three.
    """
    count = len(skin.faces)
    if count <= ENOUGH:
        return skin
    log(f"checking a mesh of {count} triangles")
    rough = roughness(skin)
    # Quadrics follow each noisy corner, and tie the skin into knots.
    even = averaged(skin, math.ceil(_ROUNDS * count / MOST)) if rough >= ROUGH else skin
    tolerance, places = _TOLERANCE * 2.0 * abs(even.volume) / float(even.areas.sum()), even.spread()
    for most in (ENOUGH, 2 * ENOUGH, MOST):
        found = simplified(even, most, like=skin)
        distances = ClosestPoints(found.points[found.faces])(places).distances
        if float(np.sqrt((distances**2).mean())) <= tolerance:
            break
    if found is even:
        return skin
    noise = "" if even is skin else f", after smoothing its noise of {rough:.0f} degrees"
    log(f"mesh simplified to {len(found.faces)} triangles{noise}")
    return found


def simplified(skin: Skin, count: int, *, like: Skin | None = None, most: float = math.inf) -> Skin:
    """Return a skin of about `count` triangles by quadrics, its volume about the same; as it is if it has no more.

    More, up to `most`, are left where fewer would open a seam or share an edge among three, compared with the skin that
    it is `like`. Where more than `most` would be, it has about `count` that share some.
    """
    reference = skin if like is None else like
    opened, crowded, count = reference.open_edges, reference.crowded_edges, max(count, 4)
    knotted = None
    while count < len(skin.faces):
        points, faces = fast_simplification.simplify(skin.points, skin.faces, target_count=count)
        found = Skin.compact(points.astype(np.float64), faces.astype(np.int64))
        if len(found.faces) >= 4 and found.open_edges <= opened and found.crowded_edges <= crowded:
            return found
        knotted = found if knotted is None and found.open_edges <= opened else knotted
        count *= 2
        if knotted is not None and min(count, len(skin.faces)) > most:
            return knotted
    return skin


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
                f"expected a wall of at most {1000 * _HOLLOW * held:.3g} mm in a mesh that is {1000 * held:.3g} mm "
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
            raise several_parts("mesh", (10_000 * areas).tolist(), "cm2")
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
    ends = skin.faces[:, [[0, 1], [1, 2]]].reshape(-1, 2)
    label = components(ends, len(skin.points))[skin.faces[:, 0]]
    found = int(label.max()) + 1
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
    label = components(ends, len(used))
    middles = np.stack(
        [np.bincount(label, weights=skin.points[used, axis]) / np.bincount(label) for axis in range(3)], axis=1
    )
    start, end = skin.points[used[ends[:, 0]]], skin.points[used[ends[:, 1]]]
    return np.stack([end, start, middles[label[ends[:, 0]]]], axis=1)
