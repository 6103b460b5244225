"""The parts of the search: motions, their errors, one-sided parts, fits, and what follows from what."""

import math

import numpy as np
import pytest

from avmsf.symmetry.alignment import TOLERANCE, SymmetryTest
from avmsf.symmetry.group import SymmetryGroup
from avmsf.symmetry.motion import Motion
from avmsf.symmetry.order import as_order, find_order

X, Y, Z = np.eye(3)
MIDDLE = np.zeros(3)


def egg(count: int = 6000, seed: int = 0) -> np.ndarray:
    """An ellipsoid of about unit diagonal."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] * np.array([0.38, 0.28, 0.18])


def divided(points: np.ndarray) -> SymmetryTest:
    return SymmetryTest(points, np.random.default_rng(0))


def test_motions_keep_their_plane_or_axis():
    mirror = Motion(np.array([0.6, 0.8, 0.0]), np.array([0.6, 0.8, 5.0]), None)
    assert np.allclose(mirror.apply(np.zeros((1, 3))), [[1.2, 1.6, 0.0]])
    turn = Motion(Z, X, math.pi / 2)
    assert np.allclose(turn.apply(np.array([[2.0, 0, 3], [1, 0, 9]])), [[1, 1, 3], [1, 0, 9]])
    # A reflection's image under a quarter turn about z through x: the plane y = -1 + x's offset.
    image = Motion(X, np.zeros(3), None).conjugated_by(turn)
    points = np.random.default_rng(0).normal(size=(9, 3))
    there = turn.apply(Motion(X, np.zeros(3), None).apply(points))
    assert np.allclose(image.apply(turn.apply(points)), there)
    assert Motion(Z, X, 1.0).is_near(Motion(-Z, X + 7 * Z, 2.0), degrees=1e-4, gap=1e-9)


def test_a_symmetry_has_no_error_and_a_wrong_plane_has_one():
    cloud = divided(egg())
    assert cloud.error(Motion(X, MIDDLE, None)) < 0.05
    # Shifting the plane by s moves all images by 2 s along x; what counts is their distance along the normal.
    points = egg()
    normals = points / np.array([0.38, 0.28, 0.18]) ** 2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    expected = math.sqrt((normals[:, 0] ** 2).mean()) * 0.04 / cloud.spacing
    # The points are dense at the tips, the queries even: a few percent.
    assert cloud.error(Motion(X, 0.02 * X, None)) == pytest.approx(expected, rel=0.15)


def test_noise_is_taken_away_from_the_error():
    noisy = egg() + 0.01 * np.random.default_rng(1).normal(size=(6000, 3))
    cloud = divided(noisy)
    assert cloud.noise > 0.01
    assert cloud.error(Motion(X, MIDDLE, None)) < 0.15


def test_the_fewer_the_points_the_less_error_passes_for_chance():
    tolerances = [divided(egg(count)).tolerance for count in (240, 500, 1000, 6000)]
    assert tolerances == sorted(tolerances)
    # The noise of 1500 dense queries is known to .01 spacings squared.
    assert tolerances[-1] == pytest.approx(TOLERANCE, abs=0.02)


def test_a_part_on_one_side_is_wrong():
    points = egg()
    rod = np.random.default_rng(2).random((500, 2)) * np.array([0.3, 2 * math.pi])
    rod = np.stack([0.36 + rod[:, 0], 0.04 * np.cos(rod[:, 1]), 0.04 * np.sin(rod[:, 1])], axis=1)
    handled = divided(np.concatenate([points, rod])).error(Motion(X, MIDDLE, None))
    # Points of the rod have no counterpart and count 3 spacings each.
    assert handled == pytest.approx(3 * math.sqrt(500 / 6500), rel=0.35)


def test_a_tube_of_twelve_sides_is_nearly_round_and_yet_has_an_order():
    random = np.random.default_rng(0)
    side, place, height = random.integers(12, size=8000), random.random((8000, 1)), random.random(8000)
    corners = 0.3 * np.stack([np.cos(np.arange(13) * math.pi / 6), np.sin(np.arange(13) * math.pi / 6)], axis=1)
    tube = np.c_[corners[side] + place * (corners[side + 1] - corners[side]), 0.7 * height]
    test = divided(tube)
    # Any turn is within the tolerance: the sides lie 3.4 % of the radius inside the corners' circle at most.
    assert as_order(test, Motion(Z, MIDDLE, math.pi), None, tolerance=0.35) is not None
    assert find_order(test, Motion(Z, MIDDLE, math.pi), tolerance=0.35).order == 12


def test_of_planes_that_no_order_allows_side_by_side_the_better_stays():
    group = SymmetryGroup(divided(egg(1000)))
    near = np.array([math.cos(0.15), math.sin(0.15), 0.0])
    group.mirrors = [Motion(near, MIDDLE, None, error=0.3), Motion(X, MIDDLE, None, error=0.2)]
    group.drop_crowded_mirrors()
    assert [each.error for each in group.mirrors] == [0.2]
    assert [each.error for each in group.rejected] == [0.3]
