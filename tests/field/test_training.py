"""The network of gains, its losses and its training."""

import math
from dataclasses import replace
from functools import cache
from itertools import product

import pytest
import torch
from torch import nn

from avmsf.features.feature_field import FeatureField
from avmsf.field.config import AttentionShape, FitConfig
from avmsf.field.gains.attention import Attention, AttentionGains
from avmsf.field.gains.data import GainData, gain_data
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.training import AdamW, Targets, TrainingRun
from avmsf.mesh.points import cluster
from avmsf.modal.residual_noise import noise_power
from avmsf.modal.spectra import magnitude_stft
from factories.made_fields import with_biases
from factories.plate_field import QUICK, plate_extraction, plate_features, plate_impacts
from oracles.plain_training import STEPS, PlainRun, full_setting, start

SHAPE = AttentionShape(clusters=5, bands=3, width=8, hidden=12, layers=2, feature_scale=4.0)
GAIN_SCALE = torch.tensor([1.0, 0.5, 0.0, 20.0])


def points(count: int = 60) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 0.2, 0.1])


def features() -> FeatureField:
    descriptors = torch.randn(60, 7, generator=torch.Generator().manual_seed(1))
    return FeatureField(points(), descriptors, "test")


def network(shape: AttentionShape = SHAPE, field: FeatureField | None = None) -> AttentionGains:
    known, generator = features() if field is None else field, torch.Generator().manual_seed(2)
    return with_biases(AttentionGains(known, gain_scale=GAIN_SCALE, shape=shape, generator=generator))


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


def test_gains_are_those_of_the_nearest_point_at_any_place_and_size_of_the_object():
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


SIZES, HOPS = (256, 64, 30), (64, 16, 7)


def sounds(contacts: int = 3, samples: int = 1000, *, seed: int = 0) -> torch.Tensor:
    return torch.randn(contacts, samples, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def plain_loss(made, recorded, sizes=SIZES, hops=HOPS, *, first: int = 0, every: int = 1) -> torch.Tensor:
    loss = torch.zeros((), dtype=torch.float64)
    for fft_size, hop in zip(sizes, hops, strict=True):
        truth, found = (magnitude_stft(each, fft_size=fft_size, hop=hop) for each in (recorded, made))
        # Of fewer frames than turns each has its turn.
        turns = min(every, truth.shape[2])
        chosen = (..., slice(first % turns, None, turns))
        loss = loss + (found - truth)[chosen].abs().sum() / truth[chosen].sum()
    return loss


@pytest.mark.parametrize(
    ("sizes", "hops", "samples", "first", "every"),
    [
        # A hop that divides the FFT, hops that do not, one longer than the FFT, sounds shorter than the FFT.
        (SIZES, HOPS, 1000, 0, 1), ((64,), (64,), 640, 0, 1), ((64,), (100,), 999, 0, 1), ((512,), (128,), 50, 0, 1),
        ((16, 8), (1, 3), 33, 0, 1),
        *((SIZES, HOPS, *case) for case in product((1000, 40), (0, 1, 4), (2, 3, 5)) if case[1] < case[2]),
        *((SIZES, HOPS, samples, 9, 50) for samples in (1000, 40)),
    ],
)  # fmt: skip
def test_loss_and_gradient_are_those_of_autograd_through_the_transform(sizes, hops, samples, first, every):
    """Of all frames, or of those whose turn it is."""
    recorded = sounds(samples=samples, seed=1)
    made, plain = (sounds(samples=samples).requires_grad_() for _ in range(2))
    target = spectral_target(recorded, fft_sizes=sizes, hops=hops)
    # Scaled, so that the outer gradient is seen to be applied.
    loss = 3 * spectral_loss(made, target, first=first, every=every)
    expected = 3 * plain_loss(plain, recorded, sizes, hops, first=first, every=every)
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-12)
    loss.backward()
    expected.backward()
    # Float64 sums over some hundred frames.
    torch.testing.assert_close(made.grad, plain.grad, rtol=0, atol=1e-12 * float(plain.grad.abs().max()))


def test_frames_that_do_not_fit_one_chunk_are_none_the_worse(monkeypatch):
    recorded, made = sounds(seed=1), sounds().requires_grad_()
    target = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS)
    whole = spectral_loss(made, target)
    (gradient,) = torch.autograd.grad(whole, made)
    monkeypatch.setattr("avmsf.field.losses.CHUNK_SAMPLES", 3 * 256)
    again = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS)
    for one, other in zip(target.resolutions, again.resolutions, strict=True):
        assert torch.equal(one.magnitudes, other.magnitudes)
    parts = spectral_loss(made, target)
    assert float(parts.detach()) == pytest.approx(float(whole.detach()), rel=1e-12)
    torch.testing.assert_close(torch.autograd.grad(parts, made)[0], gradient, rtol=0, atol=1e-15)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e3])
def test_the_loss_is_relative_to_the_recording(unit: float):
    recorded, made = unit * sounds(seed=1).float(), unit * sounds().float()
    target = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS)
    # Rounding alone: the target's magnitudes are made by torch.
    assert float(spectral_loss(recorded, target)) == pytest.approx(0, abs=1e-5)
    # A magnitude of zero counts as 1e-6 of the window's norm times the largest sample.
    assert float(spectral_loss(torch.zeros_like(recorded), target)) == pytest.approx(len(SIZES), abs=1e-4)
    assert float(spectral_loss(2 * recorded, target)) == pytest.approx(len(SIZES), rel=1e-4)
    assert float(spectral_loss(made, target)) == pytest.approx(float(plain_loss(sounds(), sounds(seed=1))), rel=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("silent_target", [False, True])
@pytest.mark.parametrize("silent_sound", [False, True])
def test_silence_gives_finite_losses_and_gradients(dtype, silent_target, silent_sound):
    recorded = sounds(seed=1).to(dtype) * (not silent_target)
    made = (sounds().to(dtype) * (not silent_sound)).requires_grad_()
    loss = spectral_loss(made, spectral_target(recorded, fft_sizes=SIZES, hops=HOPS))
    loss.backward()
    assert math.isfinite(float(loss.detach()))
    assert bool(torch.isfinite(made.grad).all())
    if silent_sound and silent_target:
        assert float(loss.detach()) == pytest.approx(0, abs=1e-6)


def test_a_sound_that_is_no_number_has_a_loss_that_is_none():
    made = sounds()
    made[1, 500] = math.nan
    assert math.isnan(float(spectral_loss(made, spectral_target(sounds(seed=1), fft_sizes=SIZES, hops=HOPS))))


def test_only_the_beginning_counts_where_only_that_is_asked_for():
    recorded, made = sounds(seed=1), sounds().requires_grad_()
    loss = spectral_loss(made, spectral_target(recorded, fft_sizes=SIZES, hops=HOPS, samples=300))
    expected = plain_loss(made.detach()[:, :300], recorded[:, :300])
    assert float(loss.detach()) == pytest.approx(float(expected), rel=1e-12)
    loss.backward()
    assert torch.equal(made.grad[:, 300:], torch.zeros(3, 700, dtype=torch.float64))
    assert bool((made.grad[:, :300] != 0).all())


def test_other_sounds_are_refused():
    target = spectral_target(sounds(), fft_sizes=SIZES, hops=HOPS, samples=5000)
    # A beginning longer than the sound is the sound.
    assert target.samples == 1000
    for other in (sounds(2), sounds(samples=900)):
        with pytest.raises(ValueError):
            spectral_loss(other, target)


def test_a_step_has_the_loss_and_gradient_of_the_plain_product_of_gains_and_atoms():
    setting, found = full_setting(0.1, count=3, sample_rate=16000.0), []
    for kind in (TrainingRun, PlainRun):
        run, targets = start(*setting, STEPS, kind=kind)
        loss = run.spectral_loss(targets)
        parameters = [each for each in run.network.parameters() if each.requires_grad]
        found.append([loss.detach(), *torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True)])
    for ours, plain in zip(*found, strict=True):
        # Float32's error of the phase at the highest frequency.
        torch.testing.assert_close(ours, plain, rtol=2e-3, atol=2e-3 * float(plain.abs().max()))


def drawn() -> list[nn.Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [nn.Parameter(torch.randn(size, generator=generator)) for size in ((3, 4), (5,), (2, 2))]


def differentiate(parameters: list[nn.Parameter], step: int) -> None:
    for each in parameters:
        each.grad = None
    # The last has no gradient at every other step.
    used = parameters if step % 2 else parameters[:2]
    torch.stack([(each - row).pow(4).sum() for row, each in enumerate(used)]).sum().backward()


def test_steps_are_those_of_torch_also_from_a_state_of_before() -> None:
    ours, theirs = drawn(), drawn()
    optimizer = AdamW(ours, 0.1, 0.3)
    reference = torch.optim.AdamW(theirs, 0.1, weight_decay=0.3, fused=True)
    for step in range(20):
        reference.param_groups[0]["lr"] = 0.1 / (1 + step)
        for parameters in (ours, theirs):
            differentiate(parameters, step)
        optimizer.step(1 / (1 + step))
        reference.step()
        if step == 10:
            moments, optimizer = optimizer.moments, AdamW(ours, 0.1, 0.3)
            optimizer.resume(moments)
    for one, other in zip(ours, theirs, strict=True):
        assert torch.equal(one, other)


SHORT = replace(QUICK, warmup_steps=2, steps=2)


@cache
def prepared(config: FitConfig) -> GainData:
    return gain_data(plate_impacts(), plate_features(), plate_extraction(plate_impacts()), config)


def begun(config: FitConfig) -> tuple[TrainingRun, Targets]:
    data = prepared(config)
    network, rows = Attention().start(data)
    return TrainingRun(network, data), Targets.of(data, rows)


def warmup_loss(config: FitConfig, offset: torch.Tensor) -> float:
    """Return the loss of a network whose gains are off by `offset` at every contact."""
    run, targets = begun(config)
    targets = replace(targets, gains=run.network.read(targets.rows).mean.detach() + offset)
    return float(run.advance(targets))


def test_equal_weights_make_equation_13_of_the_warm_up() -> None:
    modes = len(plate_extraction(plate_impacts()).bank)
    run, targets = begun(replace(SHORT, warmup_weights="equal"))
    difference = run.network.read(targets.rows).mean.detach().real - targets.gains
    expected = float(difference.square().sum() / targets.gains.square().sum())
    assert float(run.advance(targets)) == pytest.approx(expected, rel=1e-4)
    offsets = 1e-3 * torch.eye(modes)
    # One squared error, whichever mode makes it, and otherwise the energies of modes of unequal damping.
    configs = (replace(SHORT, warmup_weights=weights) for weights in ("equal", "energy"))
    plain, weighed = ([warmup_loss(config, offset) for offset in offsets] for config in configs)
    assert plain == pytest.approx([plain[0]] * modes, rel=1e-3)
    assert max(weighed) > 1.2 * min(weighed)


def test_one_norm_leaves_the_resolutions_of_equation_14_in_proportion() -> None:
    config = replace(SHORT, spectral_norm="common", interleave=1, early_weight=0.5, residual=False, hop=64)
    run, targets = begun(config)
    sizes, hops, early = config.resolutions(run.sample_rate)
    recorded = plate_impacts().sounds
    made = run.sounds(targets.rows).detach()

    def distance(samples: int | None, fft_size: int, hop: int) -> float:
        spectra = (magnitude_stft(each[:, :samples], fft_size=fft_size, hop=hop) for each in (made, recorded))
        return float((next(spectra) - next(spectra)).abs().sum())

    equation = sum(
        distance(None, *each) + config.early_weight * distance(early, *each) for each in zip(sizes, hops, strict=True)
    )
    norm = sum(
        float(magnitude_stft(recorded, fft_size=size, hop=hop).sum()) for size, hop in zip(sizes, hops, strict=True)
    )
    found = float(run.spectral_loss(targets).detach())
    assert found == pytest.approx(equation * len(sizes) / norm, rel=1e-4)
    relative, each = begun(replace(config, spectral_norm="each"))
    assert float(relative.spectral_loss(each).detach()) != pytest.approx(found, rel=0.01)


def test_regressed_gains_are_the_warm_ups_aim_without_signs() -> None:
    impacts = plate_impacts()
    turned = replace(impacts, directions=torch.tensor([[0.0, 0.0, 1.0]] * len(impacts)))
    turned.directions[::2] *= -1
    case = gain_data(turned, plate_features(), plate_extraction(impacts), replace(SHORT, warmup_gains="regression"))
    signed = gain_data(turned, plate_features(), plate_extraction(impacts), SHORT)
    assert float(case.gains.min()) >= 0
    assert float(signed.gains.min()) < 0
    # Modes that are far apart have the modulus of their bin, of a steady sine's two thirds at most.
    strong = signed.gains.abs() > 0.3 * signed.gains.abs().amax(1, keepdim=True)
    ratio = (case.gains / signed.gains.abs())[strong & (case.gains > 0)]
    assert 0.2 < float(ratio.median()) < 0.75


def test_the_residual_may_start_from_the_quietest_segments() -> None:
    impacts, modes = plate_impacts(), plate_extraction(plate_impacts())
    bins = len(modes.residual.magnitude)
    case = prepared(replace(SHORT, residual_start="quietest"))
    expected = noise_power(impacts.sounds.float(), bins=bins).mean(0).sqrt()
    assert torch.equal(case.modes.residual.magnitude, expected)
    assert torch.equal(prepared(SHORT).modes.residual.magnitude, modes.residual.magnitude)
