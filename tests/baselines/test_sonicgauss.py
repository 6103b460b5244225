"""SonicGauss: what flow and conditioning must obey."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.baselines.sonicgauss.conditioning import ContactEncoding, Fusion, first_nine, normalized
from avmsf.baselines.sonicgauss.training import TrainingConfig, draw_times, flow_loss, integrate, train
from avmsf.errors import EvaluationError
from factories.clouds import cloud
from factories.raising import raises


def test_straight_paths_arrive_exactly_whatever_the_steps():
    data, noise = torch.randn(2, 3, 5, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for steps in (1, 7):
        torch.testing.assert_close(integrate(lambda state, times: noise - data, noise, steps=steps), data)


def test_sampling_agrees_with_the_published_scheduler():
    diffusers = pytest.importorskip("diffusers")
    scheduler = diffusers.FlowMatchEulerDiscreteScheduler(num_train_timesteps=1000)
    scheduler.set_timesteps(sigmas=torch.linspace(1.0, 1 / 50, 50).numpy())
    noise = torch.randn(1, 3, 2, generator=torch.Generator().manual_seed(0))
    state = noise
    for time in scheduler.timesteps:
        state = scheduler.step(torch.sin(state) * (time / 1000), time, state).prev_sample
    ours = integrate(lambda latents, times: torch.sin(latents) * times[:, None, None], noise)
    torch.testing.assert_close(ours, state, rtol=1e-4, atol=1e-5)


def test_the_loss_vanishes_for_the_true_velocity_alone():
    data = torch.full((4, 2, 3), 1.5)

    # Of data that are all alike the noise can be told from the state, and with it the velocity.
    def true(state: torch.Tensor, times: torch.Tensor) -> torch.Tensor:
        return (state - data) / times[:, None, None]

    assert float(flow_loss(true, data, generator=torch.Generator().manual_seed(0))) < 1e-6
    wrong = flow_loss(lambda state, times: -true(state, times), data, generator=torch.Generator().manual_seed(0))
    assert float(wrong) > 1.0


def test_times_have_the_published_distribution():
    times = draw_times(20_000, generator=torch.Generator().manual_seed(0))
    logits = torch.logit(times.double())
    assert float(logits.mean()) == pytest.approx(0.0, abs=0.03)
    assert float(logits.std()) == pytest.approx(1.0, abs=0.02)


def test_channels_do_not_change_where_the_object_lies_or_how_large_it_is():
    one = cloud(degree=2)
    other = replace(one, centers=3.0 * one.centers + 0.7, log_scales=one.log_scales + math.log(3.0))
    here, there = (normalized(each, first_nine(each)) for each in (one, other))
    torch.testing.assert_close(here.features, there.features, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(
        here.places(one.centers.double()), there.places(other.centers.double()), rtol=1e-4, atol=1e-4
    )
    assert here.features.shape[1] == 23
    assert float(here.centers.min()) == pytest.approx(0.0, abs=1e-6)
    assert float(here.centers.max()) == pytest.approx(1.0, abs=1e-6)


def test_faint_gaussians_are_left_out_and_none_is_an_error():
    one = cloud(20)
    opacities = torch.where(torch.arange(20) < 5, 0.01, 0.5)
    assert len(normalized(replace(one, logit_opacities=opacities), first_nine(one)).centers) == 15
    with raises(EvaluationError, name="opacity", value=20):
        normalized(replace(one, logit_opacities=torch.zeros(20)), first_nine(one))
    with raises(EvaluationError, name="centers", value=20):
        normalized(replace(one, centers=torch.zeros(20, 3)), first_nine(one))


def test_the_published_rest_is_the_first_nine_of_a_file_of_degree_three():
    one = cloud(3, degree=3)
    # A file holds all 15 of red, then green, then blue.
    in_file = torch.cat([one.harmonics[:, 1:, color] for color in range(3)], dim=1)
    torch.testing.assert_close(first_nine(one), in_file[:, :9])
    assert bool((first_nine(cloud(3, degree=0)) == 0).all())


def test_a_contact_is_encoded_by_sines_and_cosines_of_octaves():
    encoding = ContactEncoding((8,), 63)
    encoding.mlp = torch.nn.Identity()
    place = torch.tensor([[0.3, 0.6, 0.9]])
    found = encoding(place)[0]
    assert found.shape == (63,)
    # x first: sine and cosine of pi x, of 2 pi x, and so on.
    first = [turn(octave * 0.3 * math.pi) for octave in (1, 2) for turn in (math.sin, math.cos)]
    torch.testing.assert_close(found[:4], torch.tensor(first))
    assert float(found[20]) == pytest.approx(math.sin(0.6 * math.pi), abs=1e-6)
    torch.testing.assert_close(found[60:], place[0])


def test_fusion_keeps_the_objects_tokens_and_adds_those_of_the_contact():
    fusion = Fusion(16, 4).eval()
    tokens, contact = torch.randn(2, 5, 16), torch.randn(2, 16)
    found = fusion(tokens, contact)
    assert torch.equal(found[:, :5], tokens)
    assert not torch.allclose(fusion(tokens, contact + 1.0)[:, 5:], found[:, 5:], atol=1e-3)
    # With one key, attention adds the same vector to all tokens.
    fusion.ffn = torch.nn.Identity()
    fusion.norm2 = torch.nn.Identity()
    added = (fusion(tokens, contact)[:, 5:] / 2 - tokens).detach()
    torch.testing.assert_close(added, added[:, :1].expand_as(added), rtol=1e-4, atol=1e-5)


def test_training_lowers_the_loss_and_a_seed_decides_it():
    def run(seed: int) -> tuple[list[float], torch.Tensor]:
        weight = torch.nn.Parameter(torch.zeros(3))

        def loss(rows: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
            noise = torch.rand(1, generator=generator) * 1e-3
            return (weight - rows.float().mean() - noise).square().mean()

        return train([weight], loss, 5, TrainingConfig(300, batch=2, rate=0.05), seed=seed), weight.detach()

    losses, found = run(0)
    assert len(losses) == 300
    # The rows 0 to 4, each as often as any other: their mean.
    torch.testing.assert_close(found, torch.full((3,), 2.0), rtol=0, atol=0.4)
    again = run(0)
    assert again[0] == losses
    assert torch.equal(again[1], found)
    assert run(1)[0] != losses
