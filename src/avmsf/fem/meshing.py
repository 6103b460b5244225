"""A surface as people have them made fit for walls and tetrahedra: welded, turned outwards, without noise, thinned.

A scan's noise is drawn afresh at each vertex, while a surface runs on from one vertex to the next. Of the surfaces that
balance closeness to the vertices against bending, (1 + strength L L) places = vertices with L the mean difference from
the neighbors, generalized cross-validation (Craven and Wahba 1978) takes the one that predicts left-out vertices best.
Meshes of very many triangles are simplified by quadrics (Garland and Heckbert 1997).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.optimize
import scipy.sparse
import trimesh
from jaxtyping import Float64, Int
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from trimesh import Trimesh

from avmsf.errors import SimulationError
from avmsf.fem.remeshing import adjacency, boundary_edges, even_points, mesh_of
from avmsf.fem.solid import several_parts
from avmsf.mesh.level_set import decimated
from avmsf.mesh.points import connected_parts
from avmsf.mesh.queries import ClosestPoints
from avmsf.mesh.surface import Surface


@dataclass(frozen=True)
class Tolerances:
    """What a mesh may have, and what it is taken for."""

    weld_ratio: float = 2e-6  # distance of vertices that are one, over the size: text files round, STL repeats corners
    max_lost_area: float = 0.05  # part of the area that may face against its neighbors
    min_roughness_deg: float = 20.0  # mean angle between neighboring triangles, from which on noise is likelier
    max_edge: float = 0.06  # mean edge over the size, beyond which noise and form are one: a box turns by 60 degrees
    min_log_strength: float = -3.0  # decimal logarithm of the weakest smoothing
    max_log_strength: float = 5.0  # of the strongest
    max_freedom: float = 0.8  # part of the vertices' degrees of freedom that a mesh without noise would keep
    max_faces: int = 60_000  # beyond which a mesh is simplified even where that changes its form
    enough_faces: int = 16_000  # beyond which it is simplified as far as its form stays; models have some thousand
    max_distance: float = 0.01  # root mean square, of a simplified mesh over its mean thickness; by a twisted blade
    max_lids: float = 0.25  # part of the closed surface that lids over holes may make up, as `fill` has it
    max_small_lids: float = 0.02  # likewise of defects of a scan: openings of vessels are larger
    max_loose_area: float = 0.1  # part of the area in loose bits, which a wall leaves out
    min_vessel: float = 0.03  # volume behind lids over area^1.5 of a surface with an inside; .13 of a hemisphere
    max_wall: float = 1.0 / 6.0  # thickness of a guessed wall over the mean thickness of what a closed surface holds


TOLERANCES = Tolerances()
_PROBES = 8
"""Random vectors that estimate the number of degrees of freedom left, within a per cent for thousands of vertices."""
_ROUNDS = 4
"""Averages taken of a noisy mesh over the thinning: they reach little farther than an edge that stays."""


def count_crowded_edges(mesh: Trimesh) -> int:
    """Return how many edges more than two triangles share."""
    return int((np.bincount(mesh.edges_unique_inverse) > 2).sum())


def weld(surface: Surface) -> Trimesh:
    """Return a surface's triangles with vertices in one place made one, without those that have no area.

    Raises SimulationError for points without triangles, and where no triangle has an area.
    """
    points, faces = surface.vertices.double().numpy(), surface.faces.numpy()
    if not len(faces):
        got = f"{len(points)} points without triangles"
        raise SimulationError.expected("a mesh", 0, got=got, name="faces", advice="make a mesh of the points")
    places, rows = np.unique(points[faces.ravel()], axis=0, return_inverse=True)
    size = float(np.linalg.norm(np.ptp(places, axis=0)))
    pairs = cKDTree(places).query_pairs(TOLERANCES.weld_ratio * size, output_type="ndarray")
    if len(pairs):
        label = connected_parts(pairs, len(places))
        places, rows = places[np.unique(label, return_index=True)[1]], label[rows]
    welded = rows.reshape(-1, 3)
    wide = np.linalg.norm(trimesh.triangles.cross(places[welded]), axis=1) > 1e-12 * size**2
    if not wide.any():
        got, advice = f"{len(faces)} without", "scan the object again"
        raise SimulationError.expected("triangles with an area", 0.0, got=got, name="areas", advice=advice)
    return mesh_of(places, welded[wide])


def oriented(mesh: Trimesh) -> Trimesh:
    """Return a mesh without triangles that share an edge with two others or face against their neighbors.

    The widest are kept. Raises SimulationError where more than a twentieth of the area would be lost.
    """
    areas = mesh.area_faces
    used: set[tuple[int, int]] = set()
    kept = np.zeros(len(mesh.faces), dtype=bool)
    for row in np.argsort(-areas, kind="stable"):
        a, b, c = mesh.faces[row].tolist()
        sides = ((a, b), (b, c), (c, a))
        if used.isdisjoint(sides):
            used.update(sides)
            kept[row] = True
    lost = float(areas[~kept].sum() / areas.sum())
    if lost > TOLERANCES.max_lost_area:
        wanted = "triangles counter-clockwise from outside and at most two per edge"
        got, advice = f"others on {lost:.0%} of the surface", "make the normals of the mesh consistent"
        raise SimulationError.expected(wanted, lost, got=got, name="normals", advice=advice)
    return mesh_of(mesh.vertices, mesh.faces[kept])


def roughness(mesh: Trimesh) -> float:
    """Return the mean angle between the normals of neighboring triangles, degrees; 0 for a mesh of few long edges."""
    ends = mesh.vertices[mesh.face_adjacency_edges]
    if not len(ends) or np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean() > TOLERANCES.max_edge * mesh.scale:
        return 0.0
    return math.degrees(float(mesh.face_adjacency_angles.mean()))


def denoised(mesh: Trimesh) -> tuple[Trimesh, float]:
    """Return a noisy mesh without its noise, and how far that moved the vertices, meters, root mean square.

    A mesh that is not rough, or whose vertices predict each other no better when smoothed, comes back as it is, with
    0. The volume of a closed one stays.
    """
    if roughness(mesh) < TOLERANCES.min_roughness_deg:
        return mesh, 0.0
    points = np.asarray(mesh.vertices)
    # The squared difference of each vertex from the mean of its neighbors.
    difference = scipy.sparse.eye_array(len(points)) - _averaging(_joined(mesh))
    bending = (difference.T @ difference).tocsc()
    probes = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(points), _PROBES))
    identity = scipy.sparse.eye_array(len(points), format="csc")

    def smooth(exponent: float) -> tuple[Float64[np.ndarray, "points 3"], float]:
        balance = identity + 10.0**exponent * bending
        solve = splu(balance, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
        return solve(points), float((probes * solve(probes)).sum(axis=0).mean() / len(probes))

    def error(exponent: float) -> float:
        smoothed, freedom = smooth(exponent)
        return math.log(float(((smoothed - points) ** 2).mean()) / (1.0 - freedom) ** 2)

    bounds = TOLERANCES.min_log_strength, TOLERANCES.max_log_strength
    found = scipy.optimize.minimize_scalar(error, bounds=bounds, options={"xatol": 0.05})
    smoothed, freedom = smooth(float(found.x))
    if freedom > TOLERANCES.max_freedom:
        return mesh, 0.0
    result = _as_large(smoothed, mesh)
    return result, float(np.sqrt(((result.vertices - points) ** 2).sum(axis=1).mean()))


def averaged(mesh: Trimesh, rounds: int) -> Trimesh:
    """Return a mesh whose vertices were moved, so many times, to the mean of themselves and their neighbors.

    The volume of a closed one stays.
    """
    step = _averaging(_joined(mesh) + scipy.sparse.eye_array(len(mesh.vertices)))
    points = np.asarray(mesh.vertices)
    for _ in range(rounds):
        points = step @ points
    return _as_large(points, mesh)


def _averaging(joined: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Return what takes the mean over the vertices that each is joined to."""
    return scipy.sparse.diags_array(1.0 / joined.sum(axis=1)) @ joined


def _joined(mesh: Trimesh) -> scipy.sparse.csr_array:
    """Return 1 for vertices that share an edge."""
    joined = adjacency(mesh)
    joined.data[:] = 1.0
    return joined


def _as_large(points: Float64[np.ndarray, "points 3"], mesh: Trimesh) -> Trimesh:
    """Return a mesh with smoothed vertices; a closed one is scaled to the volume it had, as smoothing shrinks it."""
    smoothed = Trimesh(points, mesh.faces, process=False)
    if len(boundary_edges(mesh)) or smoothed.volume == 0.0 or mesh.volume / smoothed.volume <= 0.0:
        return smoothed
    middle = points.mean(axis=0)
    factor = float(np.cbrt(mesh.volume / smoothed.volume))
    return Trimesh(middle + factor * (points - middle), mesh.faces, process=False)


def thinned(mesh: Trimesh, *, log: Callable[[str], None]) -> Trimesh:
    """Return a mesh of at most `max_faces` triangles, fewer within the tolerance; log what was done to a larger one.

    More are left where fewer would open a seam or share an edge among three.
    """
    count, enough, most = len(mesh.faces), TOLERANCES.enough_faces, TOLERANCES.max_faces
    if count <= enough:
        return mesh
    log(f"checking a mesh of {count} triangles")
    rough = roughness(mesh)
    # Quadrics follow each noisy corner, and tie the mesh into knots.
    noisy = rough >= TOLERANCES.min_roughness_deg
    even = averaged(mesh, math.ceil(_ROUNDS * count / most)) if noisy else mesh
    tolerance, places = TOLERANCES.max_distance * 2.0 * abs(_held(even)) / even.area, even_points(even)
    for target in (enough, 2 * enough, most):
        found = simplified(even, target, like=mesh)
        distances = ClosestPoints(found.triangles)(places).distances
        if float(np.sqrt((distances**2).mean())) <= tolerance:
            break
    if found is even:
        return mesh
    noise = f", after smoothing its noise of {rough:.0f} degrees" if noisy else ""
    log(f"mesh simplified to {len(found.faces)} triangles{noise}")
    return found


def simplified(mesh: Trimesh, count: int, *, like: Trimesh | None = None, most: float = math.inf) -> Trimesh:
    """Return a mesh of about `count` triangles by quadrics, its volume about the same; as it is if it has no more.

    More, up to `most`, are left where fewer would open a seam or share an edge among three, compared with the mesh that
    it is `like`. Where more than `most` would be, it has about `count` that share some.
    """
    reference = mesh if like is None else like
    opened, crowded, count = len(boundary_edges(reference)), count_crowded_edges(reference), max(count, 4)
    knotted = None
    while count < len(mesh.faces):
        found = mesh_of(*decimated(mesh.vertices, mesh.faces, count))
        if len(boundary_edges(found)) <= opened:
            if len(found.faces) >= 4 and count_crowded_edges(found) <= crowded:
                return found
            knotted = found if knotted is None else knotted
        count *= 2
        if knotted is not None and min(count, len(mesh.faces)) > most:
            return knotted
    return mesh


@dataclass(frozen=True, eq=False)
class CheckedSurface:
    """A surface that has triangles, faces outwards and is smooth."""

    mesh: Trimesh

    @cached_property
    def width(self) -> float:
        """Extent along the second of the axes that the vertices spread along, meters: of a sheet, its narrower side."""
        return float(np.sort(principal_extents(self.mesh.vertices))[1])

    @cached_property
    def lids(self) -> float:
        """Part of the closed surface that lids straight over the holes would make up, 0 to 1."""
        area = 0.5 * float(np.linalg.norm(trimesh.triangles.cross(_lids(self.mesh)), axis=1).sum())
        return area / (area + self.mesh.area)

    @cached_property
    def mean_thickness(self) -> float | None:
        """Twice the volume over the area, meters: of a thin wall, its thickness; None for a sheet, which holds none."""
        return None if self.lids > TOLERANCES.max_lids else 2.0 * abs(_held(self.mesh)) / self.mesh.area

    def expect_filling(self) -> None:
        """Raise SimulationError where the surface is too open to be filled."""
        if self.lids > TOLERANCES.max_lids:
            got = f"{len(boundary_edges(self.mesh))} open edges whose holes are {self.lids:.0%} of the surface"
            advice = "give a wall thickness, or close the mesh"
            raise SimulationError.expected("a closed one", self.lids, got=got, name="mesh", advice=advice)

    def expect_wall(self, thickness: float, *, guessed: bool) -> None:
        """Raise SimulationError where no wall of so many meters can lie behind the surface.

        A `guessed` one cannot where the surface holds little more than it would.
        """
        if thickness >= self.width:
            wanted = f"a thickness below the object's width of {millimeters(self.width, 3)}"
            got, advice = millimeters(thickness, 3), "give a thinner wall"
            raise SimulationError.expected(wanted, thickness, got=got, name="wall", advice=advice)
        held = self.mean_thickness if guessed else None
        if held is not None and thickness > TOLERANCES.max_wall * held:
            most = 1000 * TOLERANCES.max_wall * held
            wanted = f"at most {most:.3g} mm in a mesh that is {1000 * held:.3g} mm thick on average"
            raise SimulationError.expected(wanted, thickness, got="more", name="wall", advice="use a solid body")

    def sheet(self) -> Trimesh:
        """Return what a wall can follow: the largest part, neighbors facing alike.

        Raises SimulationError where other parts are more than loose bits, and as `oriented` does.
        """
        parts = _parts(self.mesh)
        areas = np.bincount(parts, weights=self.mesh.area_faces)
        if areas[0] < (1.0 - TOLERANCES.max_loose_area) * areas.sum():
            raise several_parts("mesh", (10_000 * areas).tolist(), "cm2")
        return oriented(mesh_of(self.mesh.vertices, self.mesh.faces[parts == 0]))


def checked(surface: Surface, *, log: Callable[[str], None]) -> CheckedSurface:
    """Return a surface with inverted parts turned and noise taken out, and log what was done and what is missing.

    A mesh of very many triangles is thinned first. Raises SimulationError as `weld`.
    """
    mesh, turned = _turned(thinned(_closed(weld(surface)), log=log))
    if turned:
        log(f"{turned} of {len(mesh.faces)} triangles of the mesh faced inwards: reversed")
    before = roughness(mesh)
    mesh, moved = denoised(mesh)
    if moved:
        log(
            f"noisy mesh, adjacent triangles differ by {before:.0f} degrees on average: smoothed, vertices moved by "
            f"{1000 * moved:.2g} mm (RMS)"
        )
    result, opened = CheckedSurface(mesh), len(boundary_edges(mesh))
    if opened:
        # No mistake that could be undone: what was seen from inside alone faces inwards, and its wall lies outside.
        if _held(mesh) < -TOLERANCES.min_vessel * mesh.area**1.5:
            log(
                "open mesh whose triangles face inwards: its wall is taken to be outside; reverse the triangles if the "
                "wall is inside"
            )
        helps = "trying to close the holes" if result.lids <= TOLERANCES.max_lids else "give a wall thickness"
        log(f"the mesh has {opened} open edges: {helps}")
    return result


def millimeters(meters: float, digits: int) -> str:
    """Return a length with so many significant digits and no exponent."""
    return f"{float(f'{1000 * meters:.{digits}g}'):g} mm"


def principal_extents(places: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "3"]:
    """Return the extents of points along the axes that they spread along, the least of these axes first, meters."""
    places = places - places.mean(axis=0)
    _, axes = np.linalg.eigh(places.T @ places)
    return np.ptp(places @ axes, axis=0)


def _closed(mesh: Trimesh) -> Trimesh:
    """Return a mesh whose small holes have straight lids; as it is where they are not small, or the lids would cross.

    Holes as large as openings that an object may have stay.
    """
    if not 0.0 < CheckedSurface(mesh).lids <= TOLERANCES.max_small_lids:
        return mesh
    corners = np.concatenate([mesh.triangles, _lids(mesh)])
    points, rows = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    closed = Trimesh(points, rows.reshape(-1, 3), process=False)
    return closed if count_crowded_edges(closed) <= count_crowded_edges(mesh) else mesh


def _turned(mesh: Trimesh) -> tuple[Trimesh, int]:
    """Return a mesh whose closed parts face outwards, but for the walls of voids, and how many triangles it turned.

    A part inside the box around another may be a void, which faces inwards; it goes with the part around it.
    """
    number = _parts(mesh)
    parts = [mesh_of(mesh.vertices, mesh.faces[number == part]) for part in range(int(number.max()) + 1)]
    lowest, highest = np.stack([part.bounds for part in parts], axis=1)
    turns = np.zeros(len(parts), dtype=bool)
    for part, each in enumerate(parts):
        around = (lowest[:part] <= lowest[part]).all(axis=1) & (highest[:part] >= highest[part]).all(axis=1)
        inside = np.flatnonzero(around)
        turns[part] = turns[inside[0]] if len(inside) else not len(boundary_edges(each)) and each.volume < 0.0
    turned = turns[number]
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    return Trimesh(mesh.vertices, faces, process=False), int(turned.sum())


def _parts(mesh: Trimesh) -> Int[np.ndarray, " faces"]:
    """Return the number of the part that each triangle belongs to, the widest first; they share vertices in a part."""
    label = connected_parts(mesh.edges, len(mesh.vertices))[mesh.faces[:, 0]]
    order = np.argsort(-np.bincount(label, weights=mesh.area_faces), kind="stable")
    return np.argsort(order)[label]


def _held(mesh: Trimesh) -> float:
    """Return the volume inside a mesh whose holes have straight lids, cubic meters; less than 0 where it faces in."""
    return _volume(np.concatenate([mesh.triangles, _lids(mesh)]))


def _volume(triangles: Float64[np.ndarray, "triangles 3 3"]) -> float:
    """Return the volume between triangles and the origin, cubic meters: what they enclose where they are closed."""
    return float(np.linalg.det(triangles).sum() / 6.0)


def _lids(mesh: Trimesh) -> Float64[np.ndarray, "lids 3 3"]:
    """Return triangles from the open edges to the middle of the rim that they are of, facing as the mesh does."""
    rim = boundary_edges(mesh)
    if not len(rim):
        return np.zeros((0, 3, 3))
    used, ends = np.unique(rim, return_inverse=True)
    ends, corners = ends.reshape(-1, 2), mesh.vertices[used]
    label = connected_parts(ends, len(used))
    middles = np.stack([np.bincount(label, weights=axis) for axis in corners.T], axis=1) / np.bincount(label)[:, None]
    return np.stack([corners[ends[:, 1]], corners[ends[:, 0]], middles[label[ends[:, 0]]]], axis=1)
