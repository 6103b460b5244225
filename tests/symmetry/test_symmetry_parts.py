"""The parts of the search: motions, alignment, holes against one-sided parts, fits, and what follows from what."""

import math

import numpy as np
import pytest

from avmsf.gaussians.neighborhoods import read_neighborhoods
from avmsf.symmetry.alignment import Halves
from avmsf.symmetry.candidates import CoarseCloud, matching_pairs, mirrors_of_pairs, turns_of_pairs
from avmsf.symmetry.group import Group
from avmsf.symmetry.motions import Motion
from avmsf.symmetry.refinement import fit_motion
from avmsf.symmetry.score import Judge, Judged

X, Y, Z = np.eye(3)
MIDDLE = np.zeros(3)


def egg(count: int = 6000, seed: int = 0) -> np.ndarray:
    """An ellipsoid of about unit diagonal."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] * np.array([0.38, 0.28, 0.18])


def halves(points: np.ndarray) -> Halves:
    return Halves.of(points, 1500, bounds=(0.01, 0.02), generator=np.random.default_rng(0))


def test_motions_keep_their_plane_or_axis():
    mirror = Motion(np.array([0.6, 0.8, 0.0]), np.array([0.6, 0.8, 5.0]), None)
    assert np.allclose(mirror.apply(np.zeros((1, 3))), [[1.2, 1.6, 0.0]])
    turn = Motion(Z, X, math.pi / 2)
    assert np.allclose(turn.apply(np.array([[2.0, 0, 3], [1, 0, 9]])), [[1, 1, 3], [1, 0, 9]])
    # A reflection's image under a quarter turn about z through x: the plane y = -1 + x's offset.
    image = Motion(X, np.zeros(3), None).under(turn)
    points = np.random.default_rng(0).normal(size=(9, 3))
    there = turn.apply(Motion(X, np.zeros(3), None).apply(points))
    assert np.allclose(image.apply(turn.apply(points)), there)
    assert Motion(Z, X, 1.0).apart(Motion(-Z, X + 7 * Z, 2.0), MIDDLE) == pytest.approx((0.0, 0.0), abs=1e-5)


def test_a_symmetry_has_no_error_and_a_wrong_plane_has_one():
    cloud = halves(egg())
    right, shifted = cloud.align(Motion(X, MIDDLE, None)), cloud.align(Motion(X, 0.02 * X, None))
    assert right.error < 0.05
    assert right.missing < 0.01
    # Shifting the plane by s moves all images by 2 s along x; what counts is their distance along the normal.
    points = egg()
    normals = points / np.array([0.38, 0.28, 0.18]) ** 2
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    expected = math.sqrt((normals[:, 0] ** 2).mean()) * 0.04 / cloud.spacing
    # The points are dense at the tips, the queries even: a few percent.
    assert shifted.error == pytest.approx(expected, rel=0.15)


def test_noise_is_taken_away_from_the_error():
    noisy = egg() + 0.01 * np.random.default_rng(1).normal(size=(6000, 3))
    cloud = halves(noisy)
    assert cloud.noise > 0.01
    assert cloud.align(Motion(X, MIDDLE, None)).error < 0.15


def test_a_hole_is_missing_and_a_part_on_one_side_is_wrong():
    points = egg()
    holed = halves(points[(points[:, 0] < 0.25)]).align(Motion(X, MIDDLE, None))
    # By area: the points are crowded towards the tips.
    areas = read_neighborhoods(points).spacing ** 2
    share = areas[points[:, 0] < -0.25].sum() / areas[points[:, 0] < 0.25].sum()
    assert holed.error < 0.2
    # What lies within two spacings of the hole's border counts to it: 2 x 2 pi .25 x .017 of the egg's area of .75.
    assert share - 0.02 < holed.missing < share + 0.1
    rod = np.random.default_rng(2).random((500, 2)) * np.array([0.3, 2 * math.pi])
    rod = np.stack([0.36 + rod[:, 0], 0.04 * np.cos(rod[:, 1]), 0.04 * np.sin(rod[:, 1])], axis=1)
    handled = halves(np.concatenate([points, rod])).align(Motion(X, MIDDLE, None))
    assert handled.missing < 0.02
    # Points of the rod have no counterpart and count 3 spacings each.
    assert handled.error == pytest.approx(3 * math.sqrt(500 / 6500), rel=0.35)


def test_a_fit_finds_the_plane_and_the_axis():
    cloud = halves(egg())
    tilted = Motion(np.array([math.cos(0.15), math.sin(0.15), 0.0]), np.array([0.02, 0.0, 0.0]), None)
    degrees, gap = fit_motion(tilted, cloud, queries=1500).apart(Motion(X, MIDDLE, None), MIDDLE)
    # 9 degrees and a fiftieth of the diagonal off before; a tenth of a spacing after.
    assert degrees < 0.5
    assert gap < 0.002
    axis = Motion(np.array([0.0, math.sin(0.12), math.cos(0.12)]), np.array([0.02, 0.01, 0.0]), math.pi)
    degrees, gap = fit_motion(axis, cloud, queries=1500).apart(Motion(Z, MIDDLE, math.pi), MIDDLE)
    assert degrees < 0.5
    assert gap < 0.002


def test_matching_pairs_propose_planes_and_axes_that_no_inertia_shows():
    # Four balls of different sizes at the corners of a kite, and their mirror images far to the side: the mean and the
    # principal axes are not the plane's.
    random = np.random.default_rng(0)
    balls = [((0.2, 0.1, 0.0), 0.12), ((0.35, -0.1, 0.1), 0.08), ((0.15, -0.2, -0.1), 0.05)]
    points = [
        np.array([sign * place[0], place[1], place[2]]) + radius * direction / np.linalg.norm(direction)
        for place, radius in balls
        for sign in (1, -1)
        for direction in random.normal(size=(int(60000 * radius**2), 3))
    ]
    surface = read_neighborhoods(np.array(points))
    coarse = CoarseCloud.of(surface, surface.points[random.choice(len(points), 150, replace=False)])
    pairs = matching_pairs(surface, generator=random)
    planes = mirrors_of_pairs(surface, pairs, coarse=coarse, most=5)
    # The coarse picture is good to a fiftieth of the object, some degrees.
    assert min(sum(plane.apart(Motion(X, MIDDLE, None), MIDDLE)) for plane in planes) < 6.0
    cloud = read_neighborhoods(egg())
    pairs = matching_pairs(cloud, generator=random)
    axes = turns_of_pairs(cloud, pairs, coarse=CoarseCloud.of(cloud, cloud.points[:150]), most=10)
    for true in (X, Y, Z):
        assert min(axis.apart(Motion(true, MIDDLE, math.pi), MIDDLE)[0] for axis in axes) < 9.0


def test_two_symmetries_imply_the_third():
    group = Group(Judge(halves(egg()), 0.35))
    group.consider(Motion(X, MIDDLE, None))
    group.consider(Motion(Y, MIDDLE, None))
    assert (len(group.mirrors), len(group.turns)) == (2, 0)
    group.complete()
    (turn,) = group.turns
    assert turn.order == 2
    assert turn.motion.apart(Motion(Z, MIDDLE, None), MIDDLE)[0] < 1.0


def test_the_order_of_a_turn_is_the_largest_that_holds():
    random = np.random.default_rng(0)
    # A gear's outline of five waves, drawn up to a tube.
    angle, height = 2 * math.pi * random.random(6000), 0.5 * random.random(6000)
    radius = 0.3 + 0.04 * np.cos(5 * angle)
    tube = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    judge = Judge(halves(tube), 0.35)
    turn = judge.find_order(judge.judge(Motion(Z, MIDDLE, 2 * math.pi / 5)))
    assert turn.order == 5
    smooth = np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), height], axis=1)
    judge = Judge(halves(smooth), 0.35)
    assert judge.find_order(judge.judge(Motion(Z, MIDDLE, 2 * math.pi / 5))).continuous


def test_a_tube_of_twelve_sides_is_nearly_round_and_yet_has_an_order():
    random = np.random.default_rng(0)
    side, place, height = random.integers(12, size=8000), random.random((8000, 1)), random.random(8000)
    corners = 0.3 * np.stack([np.cos(np.arange(13) * math.pi / 6), np.sin(np.arange(13) * math.pi / 6)], axis=1)
    tube = np.c_[corners[side] + place * (corners[side + 1] - corners[side]), 0.7 * height]
    judge = Judge(halves(tube), 0.35)
    # Any turn is within the tolerance: the sides lie 3.4 % of the radius inside the corners' circle at most.
    assert judge.as_order(Motion(Z, MIDDLE, math.pi), None) is not None
    assert judge.find_order(judge.judge(Motion(Z, MIDDLE, math.pi))).order == 12


def test_of_planes_that_no_order_allows_side_by_side_the_better_stays():
    group = Group(Judge(halves(egg(1000)), 0.38))
    near = np.array([math.cos(0.15), math.sin(0.15), 0.0])
    group.mirrors = [Judged(Motion(near, MIDDLE, None), 0.3, 0.0), Judged(Motion(X, MIDDLE, None), 0.2, 0.0)]
    group.leave_contradictions()
    assert [each.error for each in group.mirrors] == [0.2]
    assert [each.error for each in group.rejected] == [0.3]


def test_what_fills_an_opening_goes_if_a_turn_respects_it():
    filling, respecting = Judged(Motion(Z, MIDDLE, None), 0.1, 0.3), Judged(Motion(Z, MIDDLE, 1.0), 0.1, 0.0, None)
    for turns, kept in (([respecting], 0), ([], 1)):
        group = Group(Judge(halves(egg(1000)), 0.38))
        group.mirrors, group.turns = [filling], list(turns)
        group.leave_openings()
        assert len(group.mirrors) == kept


def test_slack_is_for_what_rests_on_holes():
    judge = Judge(halves(egg(1000)), 0.4)
    assert judge.holds(Judged(Motion(X, MIDDLE, None), 0.39, 0.0))
    assert not judge.holds(Judged(Motion(X, MIDDLE, None), 0.39, 0.1))
    assert judge.holds(Judged(Motion(X, MIDDLE, None), 0.6, 0.1), slack=2.0)
    assert not judge.holds(Judged(Motion(X, MIDDLE, None), 0.6, 0.0), slack=2.0)
    assert not judge.holds(Judged(Motion(X, MIDDLE, None), 0.0, 0.46))
