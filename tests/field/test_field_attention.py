"""The gain network against the paper's equations 7 to 11, written out once more."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.features.feature_field import FeatureField
from avmsf.field.config import AttentionShape
from avmsf.field.gains.attention import AttentionGains
from avmsf.mesh.points import cluster

SHAPE = AttentionShape(clusters=5, bands=3, width=8, hidden=12, layers=2, feature_scale=4.0)
GAIN_SCALE = torch.tensor([1.0, 0.5, 0.0, 20.0])


def points(count: int = 60) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 0.2, 0.1])


def features() -> FeatureField:
    descriptors = torch.randn(60, 7, generator=torch.Generator().manual_seed(1))
    return FeatureField(points(), descriptors, "test")


def network(shape: AttentionShape = SHAPE, field: FeatureField | None = None, *, seed: int = 2) -> AttentionGains:
    made = AttentionGains(
        features() if field is None else field,
        gain_scale=GAIN_SCALE,
        shape=shape,
        generator=torch.Generator().manual_seed(seed),
    )
    with torch.no_grad():
        # Biases start at zero and damping factors at one; a test has to see them.
        for number, parameter in enumerate(made.parameters()):
            if parameter.ndim == 1 or not bool(parameter.any()):
                parameter.normal_(std=0.1, generator=torch.Generator().manual_seed(number))
    return made


def paper_gains(net: AttentionGains, contact: torch.Tensor) -> list[float]:
    """Return gains at one contact by the paper's equations, with loops, in float64."""
    state = {name: tensor.double() for name, tensor in net.state_dict().items()}
    place, own, bands = state["points"], state["features"] * net.shape.feature_scale, net.shape.bands
    centers, labels = cluster(place, net.shape.clusters)
    row = min(range(len(place)), key=lambda i: math.dist(place[i].tolist(), contact.tolist()))
    size = math.dist(place.amax(0).tolist(), place.amin(0).tolist()) / 2
    encoded = []
    for center in centers:  # r_k = x_i* - c_k, with its sines and cosines
        offset = ((place[row] - center) / size).tolist()
        encoded += offset
        for value in offset:
            encoded += [math.sin(2**band * math.pi * value) for band in range(bands)]
            encoded += [math.cos(2**band * math.pi * value) for band in range(bands)]
    means = [own[labels == group].mean(0) for group in range(len(centers))]  # equation 7
    query = state["query.weight"] @ torch.cat([torch.tensor(encoded, dtype=torch.float64), own[row]])  # 8
    keys = [state["key.weight"] @ mean for mean in means]  # 9
    values = [state["value.weight"] @ mean for mean in means]
    scores = [math.exp(float(key @ query) / math.sqrt(net.shape.width)) for key in keys]  # 10
    attention = [score / sum(scores) for score in scores]
    context = sum(share * value for share, value in zip(attention, values, strict=True))
    if net.shape.projection:
        context = state["project.weight"] @ context
    hidden = torch.cat([context, own[row]])  # 11
    for layer in range(net.shape.layers):
        hidden = state[f"head.{2 * layer}.weight"] @ hidden + state[f"head.{2 * layer}.bias"]
        hidden = hidden / (1 + torch.exp(-hidden))
    gains = state["to_gains.weight"] @ hidden + state["to_gains.bias"]
    return (gains * state["gain_scale"]).tolist()


def test_positive_gains_are_a_softplus_of_the_papers() -> None:
    contacts = points(70)[60:]
    plain, positive = (network(replace(SHAPE, positive=each)).predict(contacts).mean for each in (False, True))
    used = GAIN_SCALE > 0
    assert bool((plain < 0).any())
    assert bool((positive[:, used] > 0).all())
    expected = torch.log1p(torch.exp((plain / GAIN_SCALE)[:, used]))
    torch.testing.assert_close((positive / GAIN_SCALE)[:, used], expected)


@pytest.mark.parametrize("bands", [0, 3])
@pytest.mark.parametrize("layers", [0, 1, 2])
@pytest.mark.parametrize("projection", [False, True])
def test_gains_are_the_papers_equations(bands, layers, projection):
    net = network(replace(SHAPE, bands=bands, layers=layers, projection=projection))
    contacts = points(70)[60:]
    gains = net.predict(contacts)
    expected = torch.tensor([paper_gains(net, contact) for contact in contacts])
    # Float32 sums of a hundred products, relative to each mode's size.
    torch.testing.assert_close(
        gains.mean / GAIN_SCALE.clamp_min(1), expected / GAIN_SCALE.clamp_min(1), rtol=0, atol=3e-6
    )
    assert not gains.mean.is_complex()
    assert gains.damping is None


def test_gains_are_those_of_the_nearest_point_wherever_the_object_lies_and_however_large_it_is():
    moved, nudge = 3 * points() + torch.tensor([1.0, 2.0, 3.0]), torch.tensor([1e-6, 0.0, 0.0])
    here, there = (network(field=FeatureField.from_points(each)) for each in (points(), moved))
    assert torch.equal(here.predict(points() + nudge).mean, here.read(torch.arange(60)).mean)
    # Coordinates near 3 m in float32 are known to 2e-7 m, waves of 4 pi to thirty times that part of the size.
    torch.testing.assert_close(there.predict(moved).mean, here.predict(points()).mean, rtol=0, atol=1e-4)


def test_damping_factors_start_at_one_and_are_positive():
    shape = replace(SHAPE, spatial_damping=True)
    fresh = AttentionGains(features(), gain_scale=GAIN_SCALE, shape=shape, generator=torch.Generator())
    assert torch.equal(fresh.predict(points()).damping, torch.ones(60, 4))
    factors = network(shape).predict(points()).damping.detach()
    assert float(factors.min()) > 0
    assert float(factors.std(0).min()) > 0
