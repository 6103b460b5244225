"""Elastic shapes at points of a surface: a plate's own, and which way a blow goes."""

from dataclasses import replace
from functools import cache

import pytest
import torch

from avmsf.field.elasticpoints import ElasticPoints
from avmsf.simulate.block import block
from avmsf.simulate.elastic import ElasticModes, elastic_modes
from avmsf.simulate.nominal import NOMINAL

SIZE = (0.24, 0.17, 0.004)


@cache
def plate() -> ElasticModes:
    return elastic_modes(block(SIZE, (8, 6, 1)), NOMINAL, count=10)


def on_top(count: int, *, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.24, 0.17, 0.0]) + (
        torch.tensor([0.0, 0.0, 0.004], dtype=torch.float64)
    )


@cache
def surface() -> ElasticPoints:
    return ElasticPoints.of(plate(), on_top(3000))


def test_spread_points_stand_for_the_whole_surface():
    rows = surface().spread
    assert len(rows) == len(rows.unique()) == 500
    apart = torch.cdist(surface().points, surface().points[rows]).amin(1)
    # Discs of this radius around 500 points cover the plate almost twice.
    assert float(apart.max()) < 0.01


def test_normals_point_out_of_the_nearest_side():
    places = torch.tensor([[0.1, 0.1, 0.0041], [0.1, 0.1, -0.0001], [0.25, 0.08, 0.002], [0.1, -0.01, 0.002]])
    expected = [[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0]]
    assert torch.allclose(plate().normals(places), torch.tensor(expected, dtype=torch.float64), atol=1e-12)


def test_points_look_straight_in_and_shapes_have_a_mean_square_of_one():
    found = surface()
    assert torch.allclose(found.inward, torch.tensor([0.0, 0.0, -1.0]).expand(3000, 3), atol=1e-6)
    square = torch.einsum("pkd,pd->pk", found.shapes, found.inward).square().mean(0)
    assert torch.allclose(square, torch.ones(10), atol=1e-5)
    # The points leave out a little of the plate at its corners.
    assert found.size == pytest.approx((0.24**2 + 0.17**2) ** 0.5, rel=0.02)


def test_between_points_shapes_are_those_of_the_body():
    """Interpolated between points some 4 mm apart, shapes with waves of 10 cm were .045 off."""
    contacts = on_top(60, seed=1)
    blows = torch.nn.functional.normalize(torch.tensor([0.2, -0.1, -1.0]), dim=0).expand(60, 3)
    found, used = surface().along(contacts, blows)
    truth = plate().gains(contacts, blows)
    truth = truth / plate().gains(on_top(3000), torch.tensor([0.0, 0.0, -1.0]).expand(3000, 3)).square().mean(0).sqrt()
    assert float((found - truth).square().mean() / truth.square().mean()) < 0.06**2
    assert torch.allclose(used, blows.double(), atol=1e-7)


def test_at_a_point_itself_its_own_shapes_count_alone():
    found, _ = surface().along(surface().points[:5], None)
    own = torch.einsum("pkd,pd->pk", surface().shapes[:5].double(), surface().inward[:5].double())
    assert torch.allclose(found, own, atol=1e-6)


def test_directions_of_length_zero_go_straight_in_and_others_count_by_their_way_alone():
    contacts = on_top(4, seed=2)
    directions = torch.tensor([[0.0, 0, 0], [0, 0, -1], [0, 0, 2.5], [0.6, 0.8, 0]])
    found, used = surface().along(contacts, directions)
    straight, inward = surface().along(contacts, None)
    assert torch.equal(used[0], inward[0])
    assert torch.allclose(used.norm(dim=1), torch.ones(4, dtype=torch.float64))
    assert torch.allclose(found[:2], straight[:2], atol=1e-6)
    assert torch.allclose(found[2], -straight[2], atol=1e-6)
    # Across a plate nothing moves as far as through it.
    assert float(found[3].abs().max()) < 0.2 * float(straight[3].abs().max())


def test_fewer_points_than_neighbours_are_enough():
    one = ElasticPoints(surface().points[:1], surface().inward[:1], surface().shapes[:1])
    found, _ = one.along(on_top(3), None)
    assert torch.allclose(found, found[:1].expand(3, -1))


def test_a_body_asked_again_at_the_same_points_answers_from_what_it_kept():
    elastic = replace(plate())
    first = ElasticPoints.of(elastic, on_top(50))
    assert ElasticPoints.of(elastic, on_top(50)) is first
    moved = ElasticPoints.of(elastic, on_top(50, seed=3))
    assert not torch.equal(moved.points, first.points)
    assert torch.equal(ElasticPoints.of(elastic, on_top(50)).shapes, first.shapes)
