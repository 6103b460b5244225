"""Symmetries as values, the parts of their search, and those of clouds: closed-form shapes, and what has none."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from avmsf.errors import SceneError
from avmsf.mesh.surface import Surface
from avmsf.symmetry.alignment import TOLERANCE, SymmetryTest
from avmsf.symmetry.find import find_group, find_symmetries
from avmsf.symmetry.motions import Motions, reflections, rotations
from avmsf.symmetry.point_group import generate
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.looked_at import mesh_of
from factories.raising import raises

THIRD = RotationalSymmetry(torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([1.0, 0.0, 0.5]).double(), 3, 0.04)
ROUND = RotationalSymmetry(torch.tensor([0.0, 1.0, 0.0]).double(), torch.zeros(3).double(), None, 0.1)
PLANE = MirrorSymmetry(torch.tensor([0.6, 0.8, 0.0]).double(), torch.tensor([0.6, 0.8, 0.0]).double(), 0.32)
FOUND = Symmetries((ROUND, THIRD), (PLANE,), 0.0021, 0.35, math.inf)


def test_a_quarter_turn_about_a_shifted_axis_goes_counter_clockwise():
    points = torch.tensor([[2.0, 0.0, 7.0], [1.0, 0.0, -3.0]]).double()
    # Points on the axis stay.
    expected = torch.tensor([[1.0, 1.0, 7.0], [1.0, 0.0, -3.0]]).double()
    assert torch.allclose(THIRD.turn(points, math.pi / 2), expected, atol=1e-15)
    assert THIRD.turn(points.float(), 0.3).dtype == torch.float32
    assert THIRD.angles(36) == pytest.approx([0.0, 2 * math.pi / 3, 4 * math.pi / 3])
    assert ROUND.angles(4) == pytest.approx([0.0, math.pi / 2, math.pi, 3 * math.pi / 2])


def test_a_reflection_keeps_the_plane_and_swaps_its_sides():
    # The plane's distance from the origin is 1: the origin goes to twice the normal.
    points = torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.8, 4.0]]).double()
    assert torch.allclose(PLANE.reflect(points), torch.tensor([[1.2, 1.6, 0.0], [0.6, 0.8, 4.0]]).double(), atol=1e-15)


def test_symmetries_go_through_json_to_the_last_bit():
    axis = torch.randn(3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    odd = RotationalSymmetry(axis / axis.norm(), axis, 7, 0.1 / 3)
    for rejected in (math.inf, 1.7):
        stored = Symmetries((odd, ROUND), (PLANE,), 0.1, 0.35, rejected)
        read = Symmetries.from_dict(json.loads(json.dumps(stored.to_dict(), allow_nan=False)))
        assert torch.equal(read.rotations[0].axis, odd.axis)
        assert torch.equal(read.rotations[0].point, odd.point)
        assert torch.equal(read.mirrors[0].normal, PLANE.normal)
        assert [each.order for each in read.rotations] == [7, None]
        assert read.to_dict() == stored.to_dict()
        assert read.rejected == rejected


@pytest.mark.parametrize(
    "change",
    [
        {"rotations": 3},
        {"mirrors": [{"normal": [1, 0], "point": [0, 0, 0], "error": 0.1}]},
        {"mirrors": [{"normal": [2, 0, 0], "point": [0, 0, 0], "error": 0.1}]},
        {"mirrors": [{"normal": [1, 0, 0], "point": [0, math.nan, 0], "error": 0.1}]},
        {"spacing": None},
        {"rotations": [{"axis": [1, 0, 0], "point": [0, 0, 0], "order": 1, "error": 0.1}]},
    ],
)
def test_stored_symmetries_that_are_none_are_refused(change):
    with raises(SceneError, name="symmetries", value=None):
        Symmetries.from_dict(FOUND.to_dict() | change)


POSE = Rotation.from_rotvec((0.4, -1.1, 0.7))


def draw(mesh: trimesh.Trimesh, *, seed: int = 0, count: int = 4000) -> np.ndarray:
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def find(points: np.ndarray, *, seed: int = 0, scale: float = 1.0, shift: float = 0.0) -> Symmetries:
    posed = torch.from_numpy(scale * POSE.apply(points) + shift)
    return find_symmetries(posed, seed=seed)


def degrees(found: torch.Tensor, true: tuple[float, float, float]) -> float:
    direction = POSE.apply(true) / np.linalg.norm(true)
    return math.degrees(math.acos(min(1.0, abs(float(found.numpy() @ direction)))))


def test_a_box_has_three_half_turns_and_three_planes_in_any_pose_and_size():
    points = draw(trimesh.creation.box((1.0, 0.7, 0.4)))
    found = find(points, scale=3e-3, shift=5.0)
    assert [each.order for each in found.rotations] == [2, 2, 2]
    for true in ((1, 0, 0), (0, 1, 0), (0, 0, 1)):
        # A sixth of a spacing over half the box's length is about 1 degree.
        assert min(degrees(each.axis, true) for each in found.rotations) < 1.0
        assert min(degrees(each.normal, true) for each in found.mirrors) < 1.0
    assert len(found.mirrors) == 3
    for each in (*found.rotations, *found.mirrors):
        assert each.error < 0.2
        # All pass the box's middle, within a hundredth of its diagonal.
        direction = each.axis if hasattr(each, "axis") else each.normal
        offset = torch.full((3,), 5.0).double() - each.point
        along = offset @ direction
        gap = along.abs() if hasattr(each, "normal") else (offset - along * direction).norm()
        assert float(gap) < 0.01 * 1.29 * 3e-3
    # Three of four points lie .030 apart, more than 1.6 % of the diagonal, which then is the measure. The diagonal is
    # that of a box about the cloud's principal axes, which for a cloud of a box may be some percent askew.
    assert found.spacing == pytest.approx(3e-3 * 0.016 * math.sqrt(1.0 + 0.49 + 0.16), rel=0.1)


@pytest.mark.slow
def test_a_prism_of_six_is_no_round_column_though_its_inertia_is():
    found = find(draw(trimesh.creation.cylinder(1.0, 1.5, sections=6)))
    assert sorted(each.order for each in found.rotations) == [2] * 6 + [6]
    assert len(found.mirrors) == 7
    assert degrees(found.rotations[0].axis, (0, 0, 1)) < 1.0


@pytest.mark.slow
def test_a_handle_leaves_a_cup_one_plane_only():
    # An open can, 1 wide and 1.2 high, with a ring-shaped handle.
    wall = draw(trimesh.creation.cylinder(0.5, 1.2, sections=200), count=5000)
    ring = draw(trimesh.creation.torus(0.3, 0.07), seed=1, count=900)[:, [0, 2, 1]] + np.array([0.55, 0.0, 0.0])
    found = find(np.concatenate([wall[wall[:, 2] < 0.599], ring[np.hypot(ring[:, 0], ring[:, 1]) > 0.5]]))
    assert found.rotations == ()
    assert len(found.mirrors) == 1
    assert degrees(found.mirrors[0].normal, (0, 1, 0)) < 2.0


@pytest.mark.slow
def test_noise_and_uneven_cover_hide_no_symmetry():
    # Not seed 0, with which trimesh draws the faces: what is dropped would be one part of the ball.
    random = np.random.default_rng(9)
    ball = draw(trimesh.creation.icosphere(subdivisions=4), count=9000)
    points = ball[random.random(len(ball)) < 0.3 + 0.35 * (ball[:, 0] + 1)] * np.array([1.0, 0.75, 0.5])
    points += 0.01 * 2.7 * random.normal(size=points.shape)
    found = find(points)
    assert [each.order for each in found.rotations] == [2, 2, 2]
    assert len(found.mirrors) == 3
    assert max(min(degrees(each.normal, axis) for axis in np.eye(3)) for each in found.mirrors) < 2.0


@pytest.mark.parametrize("count", [240, 4000])
def test_a_blob_has_none_however_few_points_there_are(count):
    ball = trimesh.creation.icosphere(subdivisions=4)
    random = np.random.default_rng(0)
    radius = np.ones(len(ball.vertices))
    for _ in range(5):
        bump = random.normal(size=3)
        radius += random.uniform(0.2, 0.5) * np.exp((ball.vertices @ bump / np.linalg.norm(bump) - 1) / 0.15)
    found = find(draw(trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces), count=count))
    assert not found
    assert found.rejected > found.tolerance


def test_five_hundred_points_show_all_symmetries_of_a_cube():
    found = find(draw(trimesh.creation.box((1.0, 1.0, 1.0)), count=500))
    assert sorted(each.order for each in found.rotations) == [2] * 6 + [3] * 4 + [4] * 3
    assert len(found.mirrors) == 9


def test_a_bowl_that_is_part_of_a_ball_has_one_axis_only():
    angle = np.linspace(0.0, 0.45 * np.pi, 40)
    outer = np.c_[np.sin(angle), 1 - np.cos(angle)]
    inner = np.c_[0.94 * np.sin(angle), 1 - 0.94 * np.cos(angle)][::-1]
    found = find(draw(trimesh.creation.revolve(np.r_[outer, inner], sections=96)))
    assert [each.order for each in found.rotations] == [None]
    assert found.mirrors == ()
    assert degrees(found.rotations[0].axis, (0, 0, 1)) < 1.5
    assert found.rejected > found.tolerance


@pytest.mark.slow
def test_a_scanned_bowl_is_round(shared: Path):
    surface = Surface.read(shared / "meshes" / "bowl" / "textured.obj")
    found = find(draw(mesh_of(surface), count=6000))
    assert [each.order for each in found.rotations] == [None]
    assert found.mirrors == ()
    # The scan stands upright to half a degree.
    assert degrees(found.rotations[0].axis, (0, 0, 1)) < 1.5


@pytest.mark.parametrize(
    ("points", "row", "value"),
    [
        (torch.rand(100, 3), None, 100),
        (torch.rand(300, 3).index_fill(0, torch.tensor([7]), math.nan), 7, pytest.approx([math.nan] * 3, nan_ok=True)),
        (torch.arange(300.0)[:, None] * torch.ones(3), None, pytest.approx([5196, 0, 0], abs=3000)),
        (torch.zeros(300, 3), None, [0.0, 0.0, 0.0]),
    ],
)
def test_points_without_a_surface_are_refused(points, row, value):
    with raises(SceneError, row=row, name="points", value=value):
        find_symmetries(points, seed=0)


@pytest.mark.slow
def test_a_thin_slab_needs_no_more_than_1200_points():
    found = find(draw(trimesh.creation.box((0.2, 0.15, 0.02)), count=1200))
    assert ([each.order for each in found.rotations], len(found.mirrors)) == ([2, 2, 2], 3)


X, Y, Z = np.eye(3)
MIDDLE = np.zeros(3)


def mirror(normal: np.ndarray, point: np.ndarray = MIDDLE) -> Motions:
    return Motions.about(point, reflections(normal[None]))


def turn(axis: np.ndarray, angle: float, point: np.ndarray = MIDDLE) -> Motions:
    return Motions.about(point, rotations(axis, [angle]))


def egg(count: int = 6000, seed: int = 0) -> np.ndarray:
    """An ellipsoid of about unit diagonal."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] * np.array([0.38, 0.28, 0.18])


def divided(points: np.ndarray) -> SymmetryTest:
    return SymmetryTest(points, np.random.default_rng(0))


def error(cloud: SymmetryTest, motion: Motions) -> float:
    return math.sqrt(max(cloud.squared_errors(motion)[0], 0.0))


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


def test_nothing_is_a_symmetry_where_chance_would_decide():
    assert divided(egg(500)).tolerance == TOLERANCE
    rough = divided(egg(240) + 0.05 * np.random.default_rng(1).normal(size=(240, 3)))
    assert rough.noise_error > TOLERANCE**2
    assert rough.tolerance == 0.0
    # Points all over a box's inside show no surface.
    inside = np.stack(np.meshgrid(*(np.linspace(-0.4, 0.4, count) for count in (12, 9, 6))), axis=-1).reshape(-1, 3)
    assert divided(inside * np.array([1.0, 0.7, 0.4])).tolerance == 0.0


def test_a_cubes_group_is_exact_though_the_turns_that_generate_it_are_off_by_degrees():
    rough = Motions.joined([turn(Z, math.pi / 2), turn(np.ones(3) / math.sqrt(3), 2 * math.pi / 3), mirror(X)])
    off = np.radians([(0.5, -1.0, 0.0), (0.0, 1.0, 0.5), (-0.5, 0.5, 1.0)])
    group = generate(Motions.joined([rough[row].displaced(vector, MIDDLE) for row, vector in enumerate(off)]))
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


def test_points_in_one_place_count_once():
    ball = trimesh.creation.uv_sphere(count=[12, 12])
    assert find_symmetries(torch.tensor(ball.vertices[ball.faces].reshape(-1, 3)), seed=0).tolerance > 0
    few = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)).repeat(3, 1)
    with raises(SceneError, name="points", value=100):
        find_symmetries(few)
