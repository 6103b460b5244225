"""Shapes made by rule: closed, filled, of the volumes and symmetries that they claim; walls of uneven thickness."""

import functools
import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from avmsf.errors import SimulationError
from avmsf.fem.solid import Solid
from avmsf.simulate.imperfections import vary_thickness
from avmsf.simulate.shapes import KINDS, Shape, make_shape
from avmsf.simulate.shapes.revolution import Profile, Turned
from factories.looked_at import mesh_of
from factories.raising import raises

HANDLES = {"mug": 1, "jug": 1, "bracket": 2, "tube": 1}
"""Holes through a shape, as through a ring."""
TURNS = dict.fromkeys(("bell", "bottle", "bowl", "goblet", "lid", "plate", "tube"), math.inf)
TURNS |= {"channel": 2, "fluted": 7, "platter": 2, "pot": 6, "tray": 2}
"""Turns about z that carry a kind's first individual onto itself: of the round ones all."""
MIRRORS = {"channel": "xy", "platter": "xyz", "tray": "xy", "boomerang": "yz", "tube": "z"}
MIRRORS |= dict.fromkeys(("mug", "scallop", "skillet", "spoon"), "y")
"""Axes across mirror planes, but for planes that contain the axis of a round, a fluted or a hexagonal shape."""
SIDES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


@functools.cache
def made(kind: str, seed: int = 1) -> Shape:
    return make_shape(kind, seed=seed)


def vertices(shape: Shape) -> np.ndarray:
    return shape.surface.vertices.double().numpy()


def turn(angle: float) -> np.ndarray:
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def mirror(normal: np.ndarray) -> np.ndarray:
    return np.eye(3) - 2.0 * np.outer(normal, normal)


def misfit(places: np.ndarray, motion: np.ndarray, *, every: int = 1) -> float:
    """Largest distance of a moved vertex, of one in `every`, from the vertices, meters."""
    return float(cKDTree(places).query(places[::every] @ motion.T)[0].max())


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_surfaces_are_closed_and_turned_outwards(kind: str) -> None:
    shape = made(kind)
    mesh = mesh_of(shape.surface)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.referenced_vertices.all()
    assert mesh.euler_number == 2 - 2 * HANDLES.get(kind, 0)
    # Single precision of vertices, some 1e-8 m of walls of 2 mm.
    assert mesh.volume == pytest.approx(shape.solid.volume, rel=1e-5)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_tetrahedra_fill_the_body_once(kind: str) -> None:
    solid = made(kind).solid
    cells, points = solid.cells.numpy(), solid.points.numpy()
    assert float(solid.volumes.min()) > 0.0
    assert int(solid.parts.max()) == 0
    sides = cells[:, SIDES].reshape(-1, 3)
    _, which, counts = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    assert counts.max() == 2
    # Two neighbors see the triangle between them from its two sides: none of them lies over the other.
    ranks = np.argsort(sides, axis=1)
    turned = np.where(np.linalg.det(np.eye(3)[ranks]) > 0, 1, -1)
    balance = np.bincount(which.ravel(), weights=turned)
    assert (balance[counts == 2] == 0).all()
    # No triangle of the skin is inside of the body: no two parts touch without being joined.
    assert len(np.unique(points.round(9), axis=0)) == len(points)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_shapes_are_of_a_size_for_the_table_and_the_computer(kind: str) -> None:
    shape = made(kind, 7)
    extent = np.ptp(vertices(shape), axis=0)
    assert 0.07 < extent.max() < 0.3
    least, most = (0.04, 0.065) if kind == "blob" else (0.0015, 0.0085)
    assert least < shape.thickness < most
    assert 2000 < len(shape.surface.faces) < 17000
    cells = shape.solid.cells.numpy()
    edges = np.unique(
        np.sort(cells[:, [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]].reshape(-1, 2), axis=1), axis=0
    )
    assert 5000 < len(shape.solid.points) + len(edges) < 15000


def normals(kind: str) -> np.ndarray:
    """Return unit normals of a kind's mirror planes, but for those that contain the axis of every angle."""
    order = TURNS[kind] if kind in ("fluted", "pot") else 0
    angles = math.pi * (np.arange(order) / max(order, 1) + 0.5)
    turned = np.stack([np.cos(angles), np.sin(angles), np.zeros(order)], axis=1)
    return np.concatenate([turned, np.eye(3)[["xyz".index(axis) for axis in MIRRORS.get(kind, "")]]])


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_shapes_have_their_symmetries(kind: str) -> None:
    places, order = vertices(made(kind)), TURNS.get(kind, 1)
    for normal in normals(kind):
        assert misfit(places, mirror(normal)) < 1e-6
    if order < math.inf:
        assert misfit(places, turn(2.0 * math.pi / order)) < 1e-6
        return
    steps = [step for step in range(3, 40) if misfit(places, turn(2.0 * math.pi / step)) < 1e-6]
    assert steps, "a wall on even rings is carried onto itself by some of its steps"


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_shapes_have_no_other_symmetries(kind: str) -> None:
    places, order = vertices(made(kind)), TURNS.get(kind, 1)
    # A millimeter is far beyond the distance between neighbors that a symmetry leaves, and within what an eye sees.
    if order < math.inf:
        for step in range(2, 13):
            if order % step:
                assert misfit(places, turn(2.0 * math.pi / step), every=9) > 1e-3, step
        for angle in np.linspace(0.0, math.pi, 24, endpoint=False):
            normal = np.array([math.cos(angle), math.sin(angle), 0.0])
            if not (np.abs(normals(kind) @ normal) > 1.0 - 1e-9).any():
                assert misfit(places, mirror(normal), every=9) > 1e-3, angle
    if "z" not in MIRRORS.get(kind, ""):
        middle = places - 0.5 * (places.max(axis=0) + places.min(axis=0))
        assert misfit(middle, mirror(np.array([0.0, 0.0, 1.0]))) > 1e-3


def test_the_volume_of_a_tube_of_many_sides() -> None:
    radius, length, wall = 0.02, 0.1, 0.003
    turned = Turned.lay(Profile([(radius, height, wall) for height in (0.0, 0.5 * length, length)]))
    sides = turned.rings.counts[0]
    # The sides of a polygon on a circle, moved by half of the wall to both sides.
    expected = sides * 2.0 * radius * math.sin(math.pi / sides) * wall * length
    assert turned.body.solid().volume == pytest.approx(expected, rel=1e-12)


def test_the_volume_of_a_bowl_by_pappus() -> None:
    radius, wall = 0.08, 0.004
    profile = Profile(
        [(0.0, 0.0, wall), (0.7 * radius, 0.0, wall), (radius, 0.3 * radius, wall), (radius, radius, wall)]
    )
    body = Turned.lay(profile, points=3000).body
    along = np.linspace(0.0, 1.0, 20001)
    middle = profile.at(along)[:, :2]
    steps = np.linalg.norm(np.diff(middle, axis=0), axis=1)
    turns = np.unwrap(np.arctan2(*np.diff(middle, axis=0).T[::-1]))
    way = 2.0 * math.pi * float((0.5 * (middle[1:, 0] + middle[:-1, 0]) * steps).sum())
    # A bent wall's cross-section has its middle outside of its middle line: the integral of sin(turn) d(turn).
    outside = 2.0 * math.pi * (math.cos(turns[0]) - math.cos(turns[-1])) * wall**3 / 12.0
    # Polygons instead of circles, smaller by a part of pi^2 / (6 n^2) for n sides, and half of that in their wall.
    assert body.solid().volume == pytest.approx(way * wall + outside, rel=4e-3)


def test_a_seed_gives_the_same_individual_and_another_seed_another() -> None:
    for kind in ("bell", "blob", "bracket", "mug"):
        one, same, other = make_shape(kind, seed=1), made(kind, 1), made(kind, 7)
        assert torch.equal(one.surface.vertices, same.surface.vertices)
        assert torch.equal(one.colors, same.colors)
        assert torch.equal(one.solid.cells, same.solid.cells)
        extents = [np.ptp(vertices(each), axis=0) for each in (one, other)]
        assert np.abs(extents[0] - extents[1]).max() > 1e-3


def test_sizes_and_walls_are_those_asked_for() -> None:
    for kind in ("mug", "blob", "platter"):
        drawn, small = made(kind), make_shape(kind, seed=1, size=0.05)
        extent = np.ptp(vertices(drawn), axis=0).max()
        assert np.ptp(vertices(small), axis=0).max() == pytest.approx(0.05, rel=1e-6)
        # A size alone scales all.
        assert small.thickness == pytest.approx(drawn.thickness * 0.05 / extent, rel=1e-6)
        assert small.solid.volume == pytest.approx(drawn.solid.volume * (0.05 / extent) ** 3, rel=1e-5)
    mug = make_shape("mug", seed=1, size=0.2, wall=0.003)
    assert np.ptp(vertices(mug), axis=0).max() == pytest.approx(0.2, rel=1e-6)
    assert mug.thickness == pytest.approx(0.003, rel=1e-4)
    assert make_shape("bowl", wall=0.004).solid.volume == pytest.approx(
        make_shape("bowl", wall=0.002).solid.volume * 2.0, rel=0.15
    )


def test_colors_tell_places_apart() -> None:
    for kind in KINDS:
        colors = made(kind).colors
        assert colors.shape == made(kind).surface.vertices.shape
        assert float(colors.min()) >= 0.0
        assert float(colors.max()) <= 1.0
        assert float(colors.std(dim=0).max()) > 0.01


def test_what_cannot_be_made() -> None:
    with raises(SimulationError, name="kind", value="cup"):
        make_shape("cup")
    with raises(SimulationError, name="wall", value=pytest.approx(0.08)):
        make_shape("mug", wall=0.08)


def chance(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def across(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a platter's points below and above each other, its rim left out."""
    points = solid.points.numpy()
    inner = (np.abs(points[:, :2]) < 0.99 * points[:, :2].max(axis=0)).all(axis=1)
    below, above = np.flatnonzero(inner & (points[:, 2] < 0)), np.flatnonzero(inner & (points[:, 2] > 0))
    return below, above[cKDTree(points[above, :2]).query(points[below, :2])[1]]


@pytest.mark.parametrize("part", [0.02, 0.1, 0.4])
def test_a_plate_varies_by_the_part_asked_for(part: float) -> None:
    solid = make_shape("platter").solid
    below, above = across(solid)
    varied = vary_thickness(solid, part, generator=chance())
    thickness = (varied.points[above] - varied.points[below])[:, 2].numpy()
    before = float((solid.points[above] - solid.points[below])[0, 2])
    # The rim, left out here, is a tenth of the points.
    assert thickness.std() / thickness.mean() == pytest.approx(part, rel=0.1)
    assert thickness.mean() == pytest.approx(before, rel=0.25 * part)
    assert varied.volume == pytest.approx(solid.volume, rel=0.25 * part)
    # Smooth: neighbors differ by little.
    _, near = cKDTree(solid.points[below].numpy()).query(solid.points[below].numpy(), k=2)
    assert np.abs(thickness - thickness[near[:, 1]]).max() < 0.5 * part * before


def test_a_tube_keeps_its_middle() -> None:
    solid = make_shape("tube").solid
    points = solid.points.numpy()
    radius = np.hypot(*points[:, :2].T)
    inner = np.flatnonzero(radius < np.median(radius))
    outer = np.flatnonzero(radius > np.median(radius))
    directions = points / np.concatenate([radius[:, None], radius[:, None], np.ones((len(points), 1))], axis=1)
    partner = outer[cKDTree(directions[outer]).query(directions[inner])[1]]
    varied = vary_thickness(solid, 0.2, generator=chance(3)).points.numpy()
    away = np.hypot(*varied[:, :2].T)
    thickness, middle = away[partner] - away[inner], 0.5 * (away[partner] + away[inner])
    assert thickness.std() / thickness.mean() == pytest.approx(0.2, rel=0.1)
    assert np.abs(middle / np.median(middle) - 1.0).max() < 0.02


@pytest.mark.parametrize("kind", ["bowl", "mug", "spoon", "blob", "bracket"])
@pytest.mark.parametrize("part", [0.03, 0.5])
def test_no_tetrahedron_is_turned_inside_out(kind: str, part: float) -> None:
    solid = make_shape(kind, seed=2).solid
    varied = vary_thickness(solid, part, generator=chance(1))
    assert torch.equal(varied.cells, solid.cells)
    varied.expect_volume()
    # No tetrahedron may be moved further than its wall grows: a point by no more than half the thickest of all walls.
    assert float((varied.points - solid.points).norm(dim=1).max()) < 1.5 * part * solid.size


def test_chance_decides_and_zero_changes_nothing() -> None:
    solid = make_shape("spoon").solid
    assert vary_thickness(solid, 0.0, generator=chance()) is solid
    one, same, other = (vary_thickness(solid, 0.05, generator=chance(seed)).points for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert float((one - other).norm(dim=1).max()) > 1e-5
