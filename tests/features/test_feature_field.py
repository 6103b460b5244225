"""Features and what pools them: nearest points, regions, fewer features of unit size, orbits, and files."""

import json
import math

import pytest
import torch
from safetensors.torch import save_file

from avmsf.errors import FitError, SceneError
from avmsf.features.feature_field import (
    FeatureField,
    load_features,
    read_report,
    reduce,
    resize,
    save_features,
    with_positions,
)
from avmsf.features.pooling import orbit_spread, refine
from avmsf.mesh.points import cluster, lattice
from avmsf.mesh.surface import Surface
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.raising import raises


def box(count: int = 200) -> torch.Tensor:
    """Points that fill a box of 0.3 by 0.2 by 0.1 m which does not lie at the origin."""
    fractions = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    return torch.tensor([1.0, -2.0, 0.5]) + fractions * torch.tensor([0.3, 0.2, 0.1])


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
    # In the triangle's plane.
    assert not bool(mesh.points[:, 2].any())
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


def test_what_was_saved_comes_back(tmp_path):
    path = tmp_path / "deep" / "features.safetensors"
    report = {"unseen": 3, "views": ["a", "b"], "agreement": 0.5}
    save_features(field(box(20)), path, report=report)
    found = load_features(path)
    assert torch.equal(found.points, field(box(20)).points)
    assert torch.equal(found.features, field(box(20)).features)
    assert found.encoder == field(box(20)).encoder
    assert read_report(path) == report
    assert [each.name for each in path.parent.iterdir()] == [path.name]


def test_a_failed_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "features.safetensors"
    save_features(field(box(20)), path)
    before = path.read_bytes()
    spoilt = FeatureField(box(20), torch.full((20, 5), torch.nan), "anyone")
    with raises(SceneError, file=path, name="features"):
        save_features(spoilt, path)
    for report in ({"a": float("nan")}, {"a": torch.zeros(1)}):
        with raises(SceneError, file=path, name="report"):
            save_features(field(box(20)), path, report=report)
    assert path.read_bytes() == before


TENSORS = {"points": torch.zeros(20, 3), "features": torch.zeros(20, 5)}


@pytest.mark.parametrize(
    ("changes", "name", "value"),
    [
        ({"sizes": {"points": 20}}, "dim", None),
        ({"sizes": {"points": 20, "dim": 0}}, "header", None),
        ({"sizes": {"points": 20, "dim": True}}, "header", None),
        ({"encoder": 3}, "header", None),
        ({"report": []}, "header", None),
        ({"sizes": {"points": 20, "dim": 6}}, "features", "float32[20, 5]"),
    ],
)
def test_a_changed_record_is_refused(tmp_path, changes, name, value):
    path = tmp_path / "f"
    record = {"format": 1, "version": "0.1.0", "encoder": "x", "sizes": {"points": 20, "dim": 5}, "report": {}}
    save_file(TENSORS, path, {"avmsf_features": json.dumps(record | changes)})
    with raises(SceneError, file=path, name=name, value=value):
        load_features(path)


SIXFOLD = RotationalSymmetry(torch.tensor([0.0, 0.0, 1.0]).double(), torch.zeros(3).double(), 6, 0.0)
ROUND = RotationalSymmetry(SIXFOLD.axis, SIXFOLD.point, None, 0.0)
UPRIGHT = MirrorSymmetry(torch.tensor([1.0, 0.0, 0.0]).double(), torch.zeros(3).double(), 0.0)


def symmetries(*found: RotationalSymmetry | MirrorSymmetry) -> Symmetries:
    kinds = RotationalSymmetry, MirrorSymmetry
    return Symmetries(*(tuple(each for each in found if isinstance(each, one)) for one in kinds), 0.05, 0.35, math.inf)


def tube(around: int = 60, along: int = 12) -> torch.Tensor:
    """Rings of points on a tube, ring after ring."""
    angle = torch.arange(around).double() * 2 * math.pi / around
    ring = torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros(around).double()], dim=1)
    return torch.cat([ring + torch.tensor([0.0, 0.0, 0.1 * step]).double() for step in range(along)])


def field(points: torch.Tensor, *, dim: int = 5, seed: int = 0) -> FeatureField:
    features = torch.randn(len(points), dim, generator=torch.Generator().manual_seed(seed))
    return FeatureField(points.float(), features, "test")


def test_an_orbits_mean_is_that_of_its_members():
    given = field(tube())
    pooled = refine(given, symmetries(SIXFOLD), iterations=1).features
    by_ring = given.features.reshape(12, 6, 10, 5).mean(dim=1, keepdim=True).expand(12, 6, 10, 5).reshape(-1, 5)
    # Sums of six float32 numbers of unit size.
    assert torch.allclose(pooled, by_ring, atol=1e-6)


def test_a_mirror_image_counts_as_much_as_the_point_itself():
    given = field(tube())
    image = [(30 - place) % 60 + 60 * ring for ring in range(12) for place in range(60)]
    pooled = refine(given, symmetries(UPRIGHT), iterations=1).features
    assert torch.allclose(pooled, (given.features + given.features[image]) / 2, atol=1e-6)


def test_pooled_features_are_the_same_all_over_an_orbit_and_stay_so():
    given, both = field(tube()), symmetries(SIXFOLD, UPRIGHT)
    once = refine(given, both)
    turned = once.features[once.nearest(SIXFOLD.turn(tube(), math.pi / 3).float())]
    assert torch.allclose(once.features, turned, atol=1e-6)
    assert torch.allclose(once.features, once.features[once.nearest(UPRIGHT.reflect(tube()).float())], atol=1e-6)
    assert torch.allclose(refine(once, both).features, once.features, atol=1e-6)
    assert orbit_spread(once, both) < 1e-6
    # Averages keep the mean over the whole object.
    assert torch.allclose(once.features.mean(0), given.features.mean(0), atol=1e-6)


def test_the_spread_of_chance_is_one_and_that_of_symmetric_features_none():
    points = tube()
    assert orbit_spread(field(points, dim=200), symmetries(SIXFOLD)) == pytest.approx(1.0, abs=0.03)
    height = FeatureField(points.float(), points[:, 2:].float(), "test")
    assert orbit_spread(height, symmetries(ROUND)) < 1e-6
    side = FeatureField(points.float(), points[:, :1].float(), "test")
    # x goes once through all its values on an orbit of 36: its variance there is 36/35 of that of the tube.
    assert orbit_spread(side, symmetries(ROUND)) == pytest.approx(math.sqrt(36 / 35), abs=0.02)


def test_a_hole_is_left_out_of_the_mean():
    points = tube(along=30)
    # What has x > 0.5 is gone: nothing lies opposite of what has x < -0.5, but for three spacings at the edge.
    kept = points[points[:, 0] < 0.5]
    given = field(kept)
    pooled = refine(given, symmetries(UPRIGHT), iterations=1).features
    lone = kept[:, 0] < -0.9
    assert torch.equal(pooled[lone], given.features[lone])
    paired = kept[:, 0].abs() < 0.45
    moved = ((pooled - given.features)[paired].abs() > 1e-3).any(dim=1)
    # All but the two points of each ring that the plane passes.
    assert int((~moved).sum()) == 2 * 30


def test_without_a_reach_the_nearest_point_counts_however_far_it_is():
    points = tube(along=4)
    given = field(points[points[:, 0] < 0.5])
    pooled = refine(given, symmetries(UPRIGHT), iterations=1, reach=0.0).features
    image = UPRIGHT.reflect(given.points.double())
    nearest = torch.cdist(image, given.points.double()).argmin(dim=1)
    assert torch.allclose(pooled, (given.features + given.features[nearest]) / 2, atol=1e-6)


def test_a_continuous_orbit_has_as_many_angles_as_asked():
    given = field(tube())
    assert torch.allclose(
        refine(given, symmetries(ROUND), angles=6).features, refine(given, symmetries(SIXFOLD)).features, atol=1e-6
    )
    smooth = refine(given, symmetries(ROUND), angles=60).features.reshape(12, 60, 5)
    assert float(smooth.std(dim=1).max()) < 1e-6


def test_without_symmetries_features_stay_and_there_is_no_orbit():
    given = field(tube())
    assert torch.equal(refine(given, symmetries()).features, given.features)
    assert refine(given, symmetries(SIXFOLD)).encoder == "test"
    with raises(SceneError, name="symmetries", value=0):
        orbit_spread(given, symmetries())
    with raises(SceneError, name="iterations", value=0):
        refine(given, symmetries(SIXFOLD), iterations=0)
