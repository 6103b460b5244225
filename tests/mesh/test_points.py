"""Choosing points, and what the surface is like about a point: against brute force and closed forms."""

import itertools
import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from avmsf.errors import CaptureError, EvaluationError, FitError
from avmsf.mesh.neighborhoods import describe_neighborhoods, read_neighborhoods
from avmsf.mesh.points import cluster, farthest_points, lattice, nearest_points
from avmsf.mesh.surface import Surface, sample_surface
from factories.looked_at import surface_of
from factories.raising import raises


def cloud(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def grid(side: int) -> torch.Tensor:
    return torch.tensor(list(itertools.product(range(side), range(side), [0])), dtype=torch.float64)


def test_farthest_points_are_the_farthest():
    points = cloud(60)
    rows = farthest_points(points, 12, start=5).tolist()
    assert rows[0] == 5
    between = torch.cdist(points, points)
    for number in range(1, 12):
        distance = between[:, rows[:number]].amin(dim=1)
        assert float(distance[rows[number]]) == float(distance.max())
    # Ties between the two remaining corners of a square go to the first row.
    corners = grid(5)[farthest_points(grid(5), 5, start=0)].tolist()
    assert corners == [[0, 0, 0], [4, 4, 0], [0, 4, 0], [4, 0, 0], [2, 2, 0]]


def test_no_row_is_chosen_twice_even_where_points_coincide():
    points = torch.zeros(6, 3)
    points[4] = 1.0
    assert farthest_points(points, 6, start=2).tolist() == [2, 4, 0, 1, 3, 5]


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 16])
def test_nearest_points_are_those_of_a_full_search_and_ties_go_to_the_first_rows(count):
    half = torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)
    # On a grid cell centers have four nearest, nodes have rings of four and more.
    for points, queries in ((cloud(40), cloud(25, seed=1)), (grid(4), torch.cat([grid(4), grid(4) + half]))):
        squares = (queries[:, None] - points).square().sum(dim=2)
        expected = squares.argsort(dim=1, stable=True)[:, :count]
        assert torch.equal(nearest_points(points, queries, count=count), expected)


def test_clusters_are_a_minimum_of_lloyds():
    points = cloud(300)
    centers, labels = cluster(points, 12)
    assert len(torch.bincount(labels)) == 12
    for label in range(12):
        assert torch.allclose(centers[label], points[labels == label].mean(dim=0), atol=1e-12)
    assert torch.equal(labels, torch.cdist(points, centers).argmin(dim=1))


def test_samples_lie_on_the_surface_evenly():
    samples = sample_surface(surface_of(trimesh.creation.box((1.0, 2.0, 4.0))), 6000, seed=0)
    # On a side of the box, the one axis along which they are at its end, to float32.
    ends = (samples.abs() - torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)).abs() < 1e-6
    assert bool(ends.any(dim=1).all())
    shares = ends.double().mean(dim=0)
    areas = torch.tensor([8.0, 4.0, 2.0], dtype=torch.float64) / 14.0
    # Four standard errors of a share of 6000.
    assert bool(((shares - areas).abs() < 4 * (areas * (1 - areas) / 6000).sqrt()).all())


def test_a_lattice_fills_the_box_to_its_corners_with_one_spacing():
    contacts = cloud(30) * torch.tensor([4.0, 2.0, 1.0], dtype=torch.float64)
    points = lattice(contacts, 500)
    assert 250 < len(points) <= 500
    assert torch.equal(points.amin(dim=0), contacts.amin(dim=0))
    assert torch.allclose(points.amax(dim=0), contacts.amax(dim=0), rtol=1e-12)
    spacing = [float(points[:, axis].unique().diff().mean()) for axis in range(3)]
    assert max(spacing) < 1.35 * min(spacing)
    assert math.prod(len(points[:, axis].unique()) for axis in range(3)) == len(points)


def test_a_lattice_of_flat_contacts_is_flat():
    contacts = cloud(30)
    contacts[:, 2] = 0.25
    points = lattice(contacts, 100)
    assert 80 < len(points) <= 100
    assert points[:, 2].unique().tolist() == [0.25]
    contacts[:, 0] = 1.0
    assert len(lattice(contacts, 100)) == 100
    contacts[:, 1] = 2.0
    assert lattice(contacts, 100).tolist() == [[1.0, 2.0, 0.25]]


TRIANGLE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
FLAT = torch.tensor([[0, 1, 1], [2, 2, 2]])


def draw(faces: torch.Tensor) -> torch.Tensor:
    return sample_surface(Surface(TRIANGLE, faces), 50, seed=0)


def test_triangles_without_area_are_passed_over():
    samples = draw(torch.cat([FLAT, torch.tensor([[0, 1, 2]])]))
    assert samples.shape == (50, 3)
    assert float(samples[:, :2].sum(1).max()) <= 1.0


@pytest.mark.parametrize(
    ("call", "kind", "name", "value"),
    [
        (lambda: farthest_points(cloud(5), 6), EvaluationError, "count", 6),
        (lambda: farthest_points(cloud(5), 2, start=5), EvaluationError, "start", 5),
        (lambda: farthest_points(cloud(5), 2, start=-1), EvaluationError, "start", -1),
        (lambda: nearest_points(cloud(5), cloud(2), count=6), EvaluationError, "count", 6),
        (lambda: lattice(cloud(5), 7), EvaluationError, "count", 7),
        (lambda: cluster(cloud(3).repeat(4, 1), 4), FitError, "count", 4),
        (lambda: cluster(cloud(0), 1), FitError, "count", 1),
        (lambda: draw(FLAT), CaptureError, "surface", 0.0),
    ],
)
def test_what_the_points_do_not_have_is_refused(call, kind, name, value):
    with raises(kind, name=name, value=value):
        call()


GRID = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)


def ball(count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_planes_normals_and_spacing():
    surface = read_neighborhoods(0.01 * GRID)
    assert np.allclose(np.abs(surface.normals[:, 2]), 1.0)
    inner = (np.abs(GRID[:, :2] - 19.5) < 10).all(axis=1)
    # The 24th neighbor's circle need not hold 24 cells exactly: between its rings of neighbors it is 10 % off.
    assert np.allclose(surface.spacing[inner], 0.01, rtol=0.1)


def test_a_balls_normals_are_radial_and_noise_is_averaged_away():
    random, clean = np.random.default_rng(1), ball()
    surface = read_neighborhoods(clean + 0.02 * random.normal(size=clean.shape))
    across = np.abs(
        np.einsum("ni,ni->n", surface.normals, surface.points / np.linalg.norm(surface.points, axis=1)[:, None])
    )
    assert np.median(across) > 0.995
    radius = np.linalg.norm(surface.points, axis=1)
    # A plane through 24 points leaves about a fifth of the noise; it lies inside the ball by a hundredth of the radius.
    assert radius.std() < 0.4 * 0.02
    assert abs(radius.mean() - 1.0) < 0.02
    # 4 pi over 4000 points, as the side of a square.
    assert abs(np.median(read_neighborhoods(clean).spacing) / np.sqrt(4 * np.pi / 4000) - 1.0) < 0.1


def test_descriptors_do_not_know_pose_or_side():
    random = np.random.default_rng(2)
    points = ball(1500) * np.array([1.0, 0.7, 0.4])
    points = points[points[:, 0] + points[:, 1] < 0.8]
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    rows, others = np.arange(0, len(points), 5), np.arange(len(points))
    first = describe_neighborhoods(read_neighborhoods(points), rows, others, diagonal=diagonal)
    turned = Rotation.random(random_state=3).apply(points * np.array([-1.0, 1.0, 1.0])) * 7.0 + random.normal(size=3)
    second = describe_neighborhoods(read_neighborhoods(turned), rows, others, diagonal=7.0 * diagonal)
    # Histograms jump where rounding moves a point over a bin's edge.
    assert (np.abs(first - second) < 1e-6).mean() > 0.99
    # They do tell places apart: the flat sides from the tips.
    assert (np.abs(first).max(axis=0) > 1.0).mean() > 0.7
