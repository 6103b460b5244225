"""The parts of the search: motions, their errors, the groups that they generate, and the largest that holds."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avmsf.symmetry.alignment import TOLERANCE, SymmetryTest
from avmsf.symmetry.motions import Motions, reflections, rotations
from avmsf.symmetry.point_group import generate
from avmsf.symmetry.search import find_group

X, Y, Z = np.eye(3)
MIDDLE = np.zeros(3)


def mirror(normal: np.ndarray, point: np.ndarray = MIDDLE) -> Motions:
    return Motions.about(point, reflections(normal[None]))


def turn(axis: np.ndarray, angle: float, point: np.ndarray = MIDDLE) -> Motions:
    return Motions.about(point, rotations(axis, [angle]))


def tilted(motions: Motions, *vectors: tuple[float, float, float]) -> Motions:
    """Return motions, each about an axis or plane that is turned by its own rotation vector, degrees."""
    parts = [motions[row].displaced(np.radians(vector), MIDDLE) for row, vector in enumerate(vectors)]
    return Motions.joined(parts)


def egg(count: int = 6000, seed: int = 0) -> np.ndarray:
    """An ellipsoid of about unit diagonal."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] * np.array([0.38, 0.28, 0.18])


def divided(points: np.ndarray) -> SymmetryTest:
    return SymmetryTest(points, np.random.default_rng(0))


def error(cloud: SymmetryTest, motion: Motions) -> float:
    return math.sqrt(max(cloud.squared_errors(motion)[0], 0.0))


def test_motions_keep_their_plane_or_axis():
    plane = mirror(np.array([0.6, 0.8, 0.0]), np.array([0.6, 0.8, 5.0]))
    assert np.allclose(plane.apply(np.zeros((1, 1, 3))), [[[1.2, 1.6, 0.0]]])
    quarter = turn(Z, math.pi / 2, X)
    assert np.allclose(quarter.apply(np.array([[[2.0, 0, 3], [1, 0, 9]]])), [[[1, 1, 3], [1, 0, 9]]])
    # Space is carried about, and the motion with it.
    rotation, shift = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, 0.3])
    points = np.random.default_rng(0).normal(size=(1, 9, 3))
    carried = Rotation.from_rotvec(rotation).apply(points[0]) + shift
    there = Rotation.from_rotvec(rotation).apply(quarter.apply(points)[0]) + shift
    assert np.allclose(quarter.displaced(rotation, shift).apply(carried[None])[0], there)


def test_planes_meet_in_a_point_and_a_plane_alone_passes_nearest_to_the_middle():
    point = np.array([0.1, -0.2, 0.3])
    assert np.allclose(Motions.joined([mirror(each, point) for each in (X, Y, Z)]).center(), point)
    assert np.allclose(mirror(X, point).center(), [0.1, 0.0, 0.0])


def test_a_symmetry_has_no_error_and_a_wrong_plane_has_one():
    cloud = divided(egg())
    assert error(cloud, mirror(X)) < 0.05
    # Shifting the plane by s moves all images by 2 s along x; what counts is their distance along the normal.
    points = egg()
    normals = points / np.array([0.38, 0.28, 0.18]) ** 2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    expected = math.sqrt((normals[:, 0] ** 2).mean()) * 0.04 / cloud.spacing
    # The points are dense at the tips, the queries even: a few percent.
    assert error(cloud, mirror(X, 0.02 * X)) == pytest.approx(expected, rel=0.15)


def test_noise_is_taken_away_from_the_error():
    cloud = divided(egg() + 0.01 * np.random.default_rng(1).normal(size=(6000, 3)))
    assert cloud.noise > 0.01
    assert error(cloud, mirror(X)) < 0.15


def test_nothing_is_a_symmetry_where_chance_would_decide():
    assert divided(egg(500)).tolerance == TOLERANCE
    rough = divided(egg(240) + 0.05 * np.random.default_rng(1).normal(size=(240, 3)))
    assert rough.noise_error > TOLERANCE**2
    assert rough.tolerance == 0.0
    # Points all over a box's inside show no surface.
    inside = np.stack(np.meshgrid(*(np.linspace(-0.4, 0.4, count) for count in (12, 9, 6))), axis=-1).reshape(-1, 3)
    assert divided(inside * np.array([1.0, 0.7, 0.4])).tolerance == 0.0


def test_a_part_on_one_side_is_wrong():
    rod = np.random.default_rng(2).random((500, 2)) * np.array([0.3, 2 * math.pi])
    rod = np.stack([0.36 + rod[:, 0], 0.04 * np.cos(rod[:, 1]), 0.04 * np.sin(rod[:, 1])], axis=1)
    cloud = divided(np.concatenate([egg(), rod]))
    # Points of the rod have no counterpart and count 3 spacings each.
    assert error(cloud, mirror(X)) == pytest.approx(3 * math.sqrt(500 / 6500), rel=0.35)


def test_a_cubes_group_is_exact_though_the_turns_that_generate_it_are_off_by_degrees():
    rough = Motions.joined([turn(Z, math.pi / 2), turn(np.ones(3) / math.sqrt(3), 2 * math.pi / 3), mirror(X)])
    group = generate(tilted(rough, (0.5, -1.0, 0.0), (0.0, 1.0, 0.5), (-0.5, 0.5, 1.0)))
    linear = np.concatenate([np.eye(3)[None], group.motions.linear])
    assert len(linear) == 48
    products = linear[:, None] @ linear
    assert np.abs(products[:, :, None] - linear).max((3, 4)).min(2).max() < 1e-9
    assert sorted(order for _, order, _ in group.axes()) == [2] * 6 + [3] * 4 + [4] * 3
    assert len(group.planes()) == 9
    assert group.contains(rough)


def test_what_generates_no_group_of_the_list_is_none():
    # Planes at 10 degrees turn by 20, less than a twelfth; those at about 60 make a triangle's group.
    across = [np.array([math.cos(angle), math.sin(angle), 0.0]) for angle in np.radians([0.0, 10.0, 62.0])]
    assert generate(Motions.joined([mirror(across[0]), mirror(across[1])])) is None
    triangle = generate(Motions.joined([mirror(across[0]), mirror(across[2])]))
    assert [order for _, order, _ in triangle.axes()] == [3]
    assert len(triangle.planes()) == 3


def test_a_continuous_axis_has_at_most_a_plane_across_or_the_body_is_a_sphere():
    oblique = np.array([0.6, 0.0, 0.8])
    groups = [generate(Motions.joined([turn(Z, 1.0), other]), Z) for other in (mirror(X), mirror(Z), mirror(oblique))]
    vase, can, ball = groups
    assert can is not None
    assert ball is not None
    assert [len(each.axes()) for each in (vase, can, ball)] == [1, 1, 2]
    assert [len(each.planes()) for each in (vase, can, ball)] == [0, 1, 0]
    assert vase.contains(Motions.joined([mirror(Y), turn(Z, 0.123)]))
    assert [each.contains(turn(X, math.pi)) for each in (vase, can, ball)] == [False, True, True]
    assert [each.contains(turn(oblique, 1.0)) for each in (vase, can, ball)] == [False, False, True]


def test_a_tube_of_twelve_sides_is_nearly_round_and_yet_has_an_order():
    random = np.random.default_rng(0)
    side, place, height = random.integers(12, size=8000), random.random((8000, 1)), random.random(8000)
    corners = 0.3 * np.stack([np.cos(np.arange(13) * math.pi / 6), np.sin(np.arange(13) * math.pi / 6)], axis=1)
    test = divided(np.c_[corners[side] + place * (corners[side + 1] - corners[side]), 0.7 * height])
    # Any turn is within the tolerance: the sides lie 3.4 % of the radius inside the corners' circle at most.
    assert test.holds(test.squared_errors(Motions.about(MIDDLE, rotations(Z, [0.3, 0.9, 2.0]))))
    group, _ = find_group(test, [turn(Z, math.pi)])
    assert [order for _, order, _ in group.axes()] == [12]
