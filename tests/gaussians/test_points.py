"""Choosing points: against brute force, on grids full of ties, and on points that coincide."""

import itertools
import math

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import CaptureError, EvaluationError, FitError
from avmsf.gaussians.points import (
    closest_points,
    cluster,
    farthest_points,
    lattice,
    nearest_points,
    sample_surface,
)
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


def test_farthest_points_of_a_square_are_its_corners_then_its_middle():
    rows = farthest_points(grid(5), 5, start=0)
    # Ties between the two remaining corners go to the first row.
    assert grid(5)[rows].tolist() == [[0, 0, 0], [4, 4, 0], [0, 4, 0], [4, 0, 0], [2, 2, 0]]


def test_no_row_is_chosen_twice_even_where_points_coincide():
    points = torch.zeros(6, 3)
    points[4] = 1.0
    assert farthest_points(points, 6, start=2).tolist() == [2, 4, 0, 1, 3, 5]


def test_closest_points_are_a_ball_around_the_start():
    points = cloud(50)
    rows = closest_points(points, 10, start=7)
    assert int(rows[0]) == 7
    distance = (points - points[7]).norm(dim=1)
    others = torch.ones(50, dtype=torch.bool)
    others[rows] = False
    assert float(distance[rows].max()) < float(distance[others].min())
    assert bool((distance[rows].diff() >= 0).all())


@pytest.mark.parametrize("count", [1, 4, 40])
def test_nearest_points_are_those_of_a_full_search(count):
    points, queries = cloud(40), cloud(25, seed=1)
    expected = torch.cdist(queries, points).argsort(dim=1)[:, :count]
    assert torch.equal(nearest_points(points, queries, count=count), expected)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_ties_go_to_the_first_rows(count):
    points = grid(4)
    # Cell centers have four nearest, nodes have rings of four and more.
    queries = torch.cat([points[:, :], points + torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)])
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


def test_more_clusters_than_positions_are_refused():
    with raises(FitError, name="count", value=4):
        cluster(cloud(3).repeat(4, 1), 4)
    with raises(FitError, name="count", value=1):
        cluster(cloud(0), 1)


def test_samples_lie_on_the_surface_evenly():
    box = trimesh.creation.box(extents=(1.0, 2.0, 4.0))
    vertices, faces = torch.tensor(np.asarray(box.vertices)), torch.tensor(np.asarray(box.faces))
    samples = sample_surface(vertices, faces, 6000, generator=torch.Generator().manual_seed(0))
    # On a side of the box, the one axis along which they are at its end.
    ends = (samples.abs() - torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)).abs() < 1e-12
    assert bool(ends.any(dim=1).all())
    shares = ends.double().mean(dim=0)
    areas = torch.tensor([8.0, 4.0, 2.0], dtype=torch.float64) / 14.0
    # Four standard errors of a share of 6000.
    assert bool(((shares - areas).abs() < 4 * (areas * (1 - areas) / 6000).sqrt()).all())


def test_triangles_without_area_are_passed_over_and_alone_refused():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 1], [0, 1, 2], [2, 2, 2]])
    samples = sample_surface(vertices, faces, 50, generator=torch.Generator().manual_seed(0))
    assert samples.shape == (50, 3)
    assert float(samples[:, :2].sum(1).max()) <= 1.0
    with raises(CaptureError, name="surface", value=0.0):
        sample_surface(vertices, faces[[0, 2]], 5, generator=torch.Generator().manual_seed(0))


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


def test_what_the_points_do_not_have_is_refused():
    for choose in (farthest_points, closest_points):
        with raises(EvaluationError, name="count", value=6):
            choose(cloud(5), 6)
        with raises(EvaluationError, name="start", value=5):
            choose(cloud(5), 2, start=5)
        with raises(EvaluationError, name="start", value=-1):
            choose(cloud(5), 2, start=-1)
    with raises(EvaluationError, name="count", value=6):
        nearest_points(cloud(5), cloud(2), count=6)
    with raises(EvaluationError, name="count", value=7):
        lattice(cloud(5), 7)
