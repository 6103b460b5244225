"""What is known of an object's points: nearest ones, regions, size; fewer features, of unit size."""

import math

import pytest
import torch

from avmsf.errors import FitError, SceneError
from avmsf.features.feature_field import FeatureField, reduce, resize, with_positions
from avmsf.mesh.points import cluster, lattice
from avmsf.mesh.surface import Surface
from factories.raising import raises


def box(count: int = 200) -> torch.Tensor:
    """Points that fill a box of 0.3 by 0.2 by 0.1 m which does not lie at the origin."""
    fractions = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    return torch.tensor([1.0, -2.0, 0.5]) + fractions * torch.tensor([0.3, 0.2, 0.1])


def test_the_nearest_point_is_the_one_at_least_distance():
    field = FeatureField.from_points(box())
    contacts = box(300)[200:] + 0.01
    brute = torch.cdist(contacts.double(), field.points.double()).argmin(1)
    assert torch.equal(field.nearest(contacts), brute)
    assert torch.equal(field.at(contacts), field.features[brute])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_region_is_described_by_the_mean_of_its_points_features(dtype):
    points = box()
    features = torch.randn(200, 5, generator=torch.Generator().manual_seed(2), dtype=dtype)
    field = FeatureField(points, features, "anyone")
    (centers, descriptors), labels = field.clusters(7), cluster(points, 7)[1]
    for group in range(7):
        # Sums of some thirty numbers of unit size in float32.
        torch.testing.assert_close(descriptors[group], features[labels == group].mean(0), rtol=0, atol=1e-6)
        torch.testing.assert_close(centers[group], points[labels == group].mean(0), rtol=0, atol=1e-6)


def test_position_features_know_neither_the_objects_place_nor_its_size():
    points = box().double()
    there = FeatureField.from_points(points)
    elsewhere = FeatureField.from_points(points * 7 + torch.tensor([3.0, 4.0, 5.0], dtype=torch.float64))
    # Rounding of float32 features of about unit size.
    torch.testing.assert_close(there.features, elsewhere.features, rtol=0, atol=2e-7)
    middle = (there.features.amax(0) + there.features.amin(0)) / 2
    assert float(middle.abs().max()) < 2e-7
    half_diagonal = float((there.features.amax(0) - there.features.amin(0)).norm()) / 2
    assert half_diagonal == pytest.approx(1, abs=1e-6)
    assert elsewhere.half_diagonal == pytest.approx(7 * there.half_diagonal, rel=1e-6)


def test_a_mesh_gives_points_on_it_and_points_alone_are_kept():
    vertices = torch.tensor([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.1, 0.0]])
    generator = torch.Generator().manual_seed(3)
    mesh = FeatureField.from_mesh(Surface(vertices, torch.tensor([[0, 1, 2]])), seed=generator, count=500)
    assert mesh.points.shape == (500, 3)
    x, y, z = mesh.points.T
    # On the triangle x / 0.2 + y / 0.1 <= 1 in the plane z = 0, to float32.
    assert float((x / 0.2 + y / 0.1).max()) <= 1 + 1e-6
    assert float(torch.minimum(x, y).min()) >= 0
    assert float(z.abs().max()) == 0
    cloud = FeatureField.from_mesh(Surface(vertices, torch.zeros(0, 3, dtype=torch.long)), seed=generator)
    assert torch.equal(cloud.points, vertices)
    # Points that stand for contacts fill the space around them.
    field = FeatureField.from_contacts(box(40), count=300)
    assert torch.equal(field.points, lattice(box(40), 300))
    assert not field.on_surface


def varied(count: int = 400) -> FeatureField:
    """Features of five dimensions that vary in three, by 9, 4 and 1 units, and do not lie about zero."""
    generator = torch.Generator().manual_seed(0)
    hidden = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    hidden = hidden - hidden.mean(0)
    # Made exactly uncorrelated, of variance one.
    hidden = hidden @ torch.linalg.inv(torch.linalg.cholesky(hidden.T @ hidden / count)).T
    turn = torch.linalg.qr(torch.randn(5, 5, generator=generator, dtype=torch.float64))[0][:3]
    features = hidden * torch.tensor([9.0, 4.0, 1.0]) @ turn + 7
    return FeatureField(torch.rand(count, 3, generator=generator), features.float(), "anyone")


def test_whitened_components_are_uncorrelated_and_of_unit_variance():
    reduced = reduce(varied(), 3).features.double()
    covariance = reduced.T @ reduced / len(reduced)
    # Components of float32 features, the smallest a seventh of the features' mean.
    torch.testing.assert_close(covariance, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-4)
    assert float(reduced.mean(0).abs().max()) < 1e-5


def test_no_more_components_come_out_than_there_are():
    reduced = reduce(varied(), 32)
    assert reduced.features.shape == (400, 3)
    assert reduced.encoder == "anyone, 3 components"
    assert reduce(varied(), 2).features.shape == (400, 2)


def test_a_size_is_the_root_mean_square_length():
    sized = resize(varied(), 0.3).features.double()
    assert float(sized.square().sum(1).mean().sqrt()) == pytest.approx(0.3, rel=1e-6)  # float32's rounding
    torch.testing.assert_close(sized / sized.norm(), varied().features.double() / varied().features.double().norm())


def test_positions_come_before_the_features():
    joined = with_positions(varied())
    geometry = FeatureField.from_points(varied().points).features
    torch.testing.assert_close(joined.features[:, :3], geometry)
    assert torch.equal(joined.features[:, 3:], varied().features)
    assert joined.encoder == "geometry and anyone"


def constant(value: float) -> FeatureField:
    return FeatureField(torch.rand(9, 3), torch.full((9, 4), value), "anyone")


@pytest.mark.parametrize(
    ("call", "kind", "name", "value"),
    [
        (lambda: FeatureField.from_points(torch.ones(5, 3)), FitError, "points", 5),
        (lambda: FeatureField.from_contacts(torch.ones(5, 3)), FitError, "points", 5),
        (lambda: FeatureField.from_points(torch.ones(0, 3)), FitError, "points", 0),
        (lambda: FeatureField.from_points(box(5).index_fill(0, torch.tensor([2]), math.nan)), FitError, "points", 5),
        (lambda: FeatureField.from_points(box(9)).clusters(10), FitError, "count", 10),
        (lambda: reduce(constant(2.5), 2), SceneError, "anyone", 9),
        (lambda: reduce(varied(), 0), SceneError, "dim", 0),
        (lambda: resize(constant(0.0), 1.0), SceneError, "anyone", 0.0),
    ],
)
def test_points_that_span_nothing_and_features_that_tell_nothing_are_refused(call, kind, name, value):
    with raises(kind, name=name, value=value):
        call()
