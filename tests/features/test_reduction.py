"""Fewer features of unit size: the same points apart, the same points together."""

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField, reduce, resize, with_positions
from factories.raising import raises


def field(count: int = 400) -> FeatureField:
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
    reduced = reduce(field(), 3).features.double()
    covariance = reduced.T @ reduced / len(reduced)
    # Components of float32 features, the smallest a seventh of the features' mean.
    torch.testing.assert_close(covariance, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-4)
    assert float(reduced.mean(0).abs().max()) < 1e-5


def test_no_more_components_come_out_than_there_are():
    reduced = reduce(field(), 32)
    assert reduced.features.shape == (400, 3)
    assert reduced.encoder == "anyone, 3 components"
    assert reduce(field(), 2).features.shape == (400, 2)


def test_features_that_tell_nothing_are_refused():
    alike = FeatureField(torch.rand(9, 3), torch.full((9, 4), 2.5), "anyone")
    with raises(SceneError, name="anyone", value=9):
        reduce(alike, 2)
    with raises(SceneError, name="dim", value=0):
        reduce(field(), 0)


def test_a_size_is_the_root_mean_square_length():
    sized = resize(field(), 0.3).features.double()
    assert float(sized.square().sum(1).mean().sqrt()) == pytest.approx(0.3, rel=1e-6)  # float32's rounding
    torch.testing.assert_close(sized / sized.norm(), field().features.double() / field().features.double().norm())
    with raises(SceneError, name="anyone", value=0.0):
        resize(FeatureField(torch.rand(9, 3), torch.zeros(9, 4), "anyone"), 1.0)


def test_positions_stand_beside_the_features():
    joined = with_positions(field())
    geometry = FeatureField.from_points(field().points).features
    torch.testing.assert_close(joined.features[:, :3], geometry)
    assert torch.equal(joined.features[:, 3:], field().features)
    assert joined.encoder == "geometry and anyone"
