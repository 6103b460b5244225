"""Pooling over orbits and mirror images, on clouds whose symmetries are exact to the last point."""

import math

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.features.pooling import orbit_spread, refine
from avmsf.symmetry.symmetries import MirrorSymmetry, RotationalSymmetry, Symmetries
from factories.raising import raises

SIXFOLD = RotationalSymmetry(torch.tensor([0.0, 0.0, 1.0]).double(), torch.zeros(3).double(), 6, 0.0)
ROUND = RotationalSymmetry(SIXFOLD.axis, SIXFOLD.point, None, 0.0)
UPRIGHT = MirrorSymmetry(torch.tensor([1.0, 0.0, 0.0]).double(), torch.zeros(3).double(), 0.0)


def symmetries(*found: RotationalSymmetry | MirrorSymmetry) -> Symmetries:
    return Symmetries(
        tuple(each for each in found if isinstance(each, RotationalSymmetry)),
        tuple(each for each in found if isinstance(each, MirrorSymmetry)),
        0.05,
        0.35,
        math.inf,
    )


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
    turned = once.at(SIXFOLD.turn(tube(), math.pi / 3).float())
    assert torch.allclose(once.features, turned, atol=1e-6)
    assert torch.allclose(once.features, once.at(UPRIGHT.reflect(tube()).float()), atol=1e-6)
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
