"""Features as the settings ask for them: what the network reads of what an encoder said."""

from dataclasses import replace

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.features.feature_field import FeatureField
from avmsf.features.lift import Lifted
from avmsf.pipeline.config import PRESETS, LiftConfig
from avmsf.pipeline.features import finish_features
from factories.raising import raises


def lifted(features: torch.Tensor) -> Lifted:
    """Return features of points without a symmetry, which all views see."""
    points = torch.rand(len(features), 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([1.0, 2.0, 4.0])
    once = torch.ones(len(features), dtype=torch.int64)
    return Lifted(FeatureField(points, features, "made"), once, once, once, 1.0)


def test_without_components_features_are_what_the_encoder_said_and_their_scale_is_reported() -> None:
    said = 40.0 + 3.0 * torch.randn(300, 16, generator=torch.Generator().manual_seed(0))
    for config in (PRESETS["paper"].scene.lift, LiftConfig(components=0)):
        features, report = finish_features(lifted(said), config)
        assert torch.equal(features.features[:, -16:], said)
    read, report = finish_features(lifted(said), PRESETS["paper"].scene.lift)
    assert report["length"] == pytest.approx(float(read.features.norm(dim=1).square().mean().sqrt()))
    # Sixteen numbers of mean 40 and standard deviation 3.
    assert report["length"] == pytest.approx(4 * 40, rel=0.01)
    assert report["variation"] == pytest.approx(4 * 3, rel=0.05)


def test_components_are_centered_and_have_the_length_that_is_asked_for() -> None:
    said = 40.0 + 3.0 * torch.randn(300, 16, generator=torch.Generator().manual_seed(0))
    features, report = finish_features(lifted(said), LiftConfig(components=4, positions=False))
    assert features.features.shape == (300, 4)
    assert (report["length"], report["variation"]) == pytest.approx((1.0, 1.0))
    beside, _ = finish_features(lifted(said), LiftConfig(components=4, feature_size=0.2))
    assert float(beside.features[:, 3:].norm(dim=1).square().mean().sqrt()) == pytest.approx(0.2)


def test_standardized_features_have_mean_zero_and_length_one() -> None:
    said = 40.0 + 3.0 * torch.randn(300, 16, generator=torch.Generator().manual_seed(0))
    config = replace(PRESETS["paper"].scene.lift, standardize=True)
    features, report = finish_features(lifted(said), config)
    assert (report["length"], report["variation"]) == pytest.approx((1.0, 1.0))
    # They differ from what was said in nothing else.
    torch.testing.assert_close(features.features * (said - said.mean(0)).norm() / 300**0.5, said - said.mean(0))


def test_features_that_say_nothing_are_refused() -> None:
    for components in (0, 4):
        with raises(SceneError, name="made", value=300):
            finish_features(lifted(torch.ones(300, 16)), LiftConfig(components=components))
