"""The spectral loss against torch's own transform and its automatic gradient."""

import math

import pytest
import torch

from avmsf.field import losses
from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.training import TrainingRun
from avmsf.modal.spectra import magnitude_stft
from oracles.plain_training import STEPS, PlainRun, full_setting, start

SIZES, HOPS = (256, 64, 30), (64, 16, 7)


def sounds(contacts: int = 3, samples: int = 1000, *, seed: int = 0) -> torch.Tensor:
    return torch.randn(contacts, samples, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def plain_loss(made: torch.Tensor, recorded: torch.Tensor, sizes=SIZES, hops=HOPS) -> torch.Tensor:
    loss = torch.zeros((), dtype=torch.float64)
    for fft_size, hop in zip(sizes, hops, strict=True):
        truth = magnitude_stft(recorded, fft_size=fft_size, hop=hop)
        loss = loss + (magnitude_stft(made, fft_size=fft_size, hop=hop) - truth).abs().sum() / truth.sum()
    return loss


# A hop that divides the FFT, hops that do not, one longer than the FFT, sounds shorter than the FFT.
@pytest.mark.parametrize(
    ("sizes", "hops", "samples"),
    [(SIZES, HOPS, 1000), ((64,), (64,), 640), ((64,), (100,), 999), ((512,), (128,), 50), ((16, 8), (1, 3), 33)],
)
def test_loss_and_gradient_are_those_of_autograd_through_the_transform(sizes, hops, samples):
    recorded = sounds(samples=samples, seed=1)
    made, plain = (sounds(samples=samples).requires_grad_() for _ in range(2))
    # Scaled, so that the outer gradient is seen to be applied.
    loss = 3 * spectral_loss(made, spectral_target(recorded, fft_sizes=sizes, hops=hops))
    expected = 3 * plain_loss(plain, recorded, sizes, hops)
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-12)
    loss.backward()
    expected.backward()
    # Float64 sums over some hundred frames.
    torch.testing.assert_close(made.grad, plain.grad, rtol=0, atol=1e-12 * float(plain.grad.abs().max()))


def test_loss_has_no_second_derivative():
    made = sounds().requires_grad_()
    loss = spectral_loss(made.square(), spectral_target(sounds(seed=1), fft_sizes=SIZES, hops=HOPS))
    with pytest.raises(NotImplementedError):
        torch.autograd.grad(loss, made, create_graph=True)


def test_loss_between_independent_noises_is_least_below_the_true_level():
    """Magnitudes X, Y of the noises are Rayleigh distributed, and E|aX - Y| is least where (1 + a^2)^1.5 = 2.

    From E[X sign(aX - Y)] = 0 with P(Y < aX) = 1 - exp(-a^2 X^2 / 2): at a = .766, 2.3 dB too low.
    """
    target = spectral_target(sounds(8, 20000, seed=1), fft_sizes=(256,), hops=(128,))
    noise, factor = sounds(8, 20000), torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    slopes = {}
    for level in (0.73, 0.80):
        factor.data.fill_(level)
        (slopes[level],) = torch.autograd.grad(spectral_loss(factor * noise, target), factor)
    # The slope crosses zero between them; 160,000 magnitudes tell it to well below a hundredth.
    assert slopes[0.73] < 0 < slopes[0.80]
    assert math.sqrt(2 ** (2 / 3) - 1) == pytest.approx(0.766, abs=1e-3)


@pytest.mark.parametrize(("first", "every"), [(0, 2), (1, 2), (2, 3), (4, 5), (9, 50)])
@pytest.mark.parametrize("samples", [1000, 40])
def test_frames_whose_turn_it_is_are_compared_alone(first, every, samples):
    recorded = sounds(samples=samples, seed=1)
    made, plain = (sounds(samples=samples).requires_grad_() for _ in range(2))
    loss = spectral_loss(made, spectral_target(recorded, fft_sizes=SIZES, hops=HOPS), first=first, every=every)
    expected = torch.zeros((), dtype=plain.dtype)
    for fft_size, hop in zip(SIZES, HOPS, strict=True):
        truth, found = (magnitude_stft(each, fft_size=fft_size, hop=hop) for each in (recorded, plain))
        # Of fewer frames than turns each has its turn.
        turns = min(every, truth.shape[2])
        chosen = (..., slice(first % turns, None, turns))
        expected = expected + (found - truth)[chosen].abs().sum() / truth[chosen].sum()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-12)
    loss.backward()
    expected.backward()
    torch.testing.assert_close(made.grad, plain.grad, rtol=0, atol=1e-12 * float(plain.grad.abs().max()))


def test_frames_that_do_not_fit_one_chunk_are_none_the_worse(monkeypatch):
    recorded, made = sounds(seed=1), sounds().requires_grad_()
    target = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS)
    whole = spectral_loss(made, target)
    (gradient,) = torch.autograd.grad(whole, made)
    monkeypatch.setattr("avmsf.field.losses._CHUNK", 3 * 256)
    again = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS)
    for one, other in zip(target.resolutions, again.resolutions, strict=True):
        assert torch.equal(one.magnitudes, other.magnitudes)
    parts = spectral_loss(made, target)
    assert float(parts.detach()) == pytest.approx(float(whole.detach()), rel=1e-12)
    torch.testing.assert_close(torch.autograd.grad(parts, made)[0], gradient, rtol=0, atol=1e-15)


def test_a_match_costs_nothing_and_silence_costs_one_a_resolution():
    recorded = sounds()
    target = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS)
    # Rounding alone: the target's magnitudes are made by torch.
    assert float(spectral_loss(recorded, target)) == pytest.approx(0, abs=1e-14)
    # A magnitude of zero counts as 1e-6 of the window's norm times the largest sample.
    assert float(spectral_loss(torch.zeros_like(recorded), target)) == pytest.approx(len(SIZES), abs=3e-5)


def test_the_loss_is_relative():
    recorded, made = sounds(seed=1), sounds()
    loss = spectral_loss(made, spectral_target(recorded, fft_sizes=SIZES, hops=HOPS))
    louder = spectral_loss(1e3 * made, spectral_target(1e3 * recorded, fft_sizes=SIZES, hops=HOPS))
    assert float(louder) == pytest.approx(float(loss), rel=1e-9)
    # Twice as loud is wrong by as much as there is.
    double = spectral_loss(2 * recorded, spectral_target(recorded, fft_sizes=SIZES, hops=HOPS))
    assert float(double) == pytest.approx(len(SIZES), rel=1e-9)


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


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_the_compiled_loop_does_what_torch_does(dtype, rounding):
    generator = torch.Generator().manual_seed(0)
    spectra = torch.view_as_complex(torch.randn(3, 4, 33, 2, dtype=dtype, generator=generator))
    target = torch.rand(3, 9, 33, dtype=dtype, generator=generator)
    # Below the floor, and no difference at all.
    spectra[1, 2, 5] = 0
    spectra[2, 1, 7], target[2, 3, 7] = 3 + 4j, 5
    slopes = [spectra.clone(), spectra.clone()]
    # The frames 1, 3, 5 and 7 of the target.
    distance = losses._compare(slopes[0], target, 1e-3, 1, 2)
    expected = losses._compare_torch(slopes[1], target, 1e-3, 1, 2)
    assert float(distance) == pytest.approx(float(expected), rel=rounding)
    torch.testing.assert_close(*slopes, rtol=0, atol=rounding)
    assert slopes[0][2, 1, 7] == 0
    assert distance.dtype == dtype


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float32, 2e-6), (torch.float64, 1e-14)])
@pytest.mark.parametrize("hop", [3, 16, 40])
def test_both_ways_to_overlap_frames_add_each_where_it_begins(dtype, rounding, hop):
    generator = torch.Generator().manual_seed(0)
    frames, window = (torch.randn(*size, dtype=dtype, generator=generator) for size in ((2, 5, 32), (32,)))
    expected = torch.full((2, 200), 2.0, dtype=dtype)
    for frame in range(5):
        expected[:, frame * hop : frame * hop + 32] += window * frames[:, frame]
    for add in (losses._overlap_add, losses._overlap_add_torch):
        found = torch.ones(2, 200, dtype=dtype)
        add(found, frames.clone(), window, hop, 0.5)
        torch.testing.assert_close(2 * found, expected, rtol=0, atol=rounding)


def test_a_sound_that_is_no_number_has_a_loss_that_is_none():
    made = sounds()
    made[1, 500] = math.nan
    assert math.isnan(float(spectral_loss(made, spectral_target(sounds(seed=1), fft_sizes=SIZES, hops=HOPS))))


def test_only_the_beginning_counts_where_only_that_is_asked_for():
    recorded = sounds(seed=1)
    target = spectral_target(recorded, fft_sizes=SIZES, hops=HOPS, samples=300)
    assert target.samples == 300
    made = sounds().requires_grad_()
    loss = spectral_loss(made, target)
    assert float(loss.detach()) == pytest.approx(
        float(plain_loss(made.detach()[:, :300], recorded[:, :300])), rel=1e-12
    )
    loss.backward()
    assert torch.equal(made.grad[:, 300:], torch.zeros(3, 700, dtype=torch.float64))
    assert bool((made.grad[:, :300] != 0).all())


def test_a_beginning_longer_than_the_sound_is_the_sound():
    assert spectral_target(sounds(), fft_sizes=SIZES, hops=HOPS, samples=5000).samples == 1000


def test_sounds_that_are_not_the_targets_are_refused():
    target = spectral_target(sounds(), fft_sizes=SIZES, hops=HOPS)
    with pytest.raises(ValueError):
        spectral_loss(sounds(2), target)
    with pytest.raises(ValueError):
        spectral_loss(sounds(samples=900), target)


def test_an_odd_transform_is_refused():
    with pytest.raises(ValueError):
        spectral_target(sounds(), fft_sizes=(64, 63), hops=(16, 16))


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3])
def test_the_loss_does_not_depend_on_the_unit_of_the_sounds(scale: float) -> None:
    generator = torch.Generator().manual_seed(0)
    truth, other = torch.randn(2, 3, 4096, generator=generator)
    losses = [
        float(spectral_loss(size * other, spectral_target(size * truth, fft_sizes=(512, 128), hops=(128, 32))))
        for size in (1.0, scale)
    ]
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    silence = spectral_loss(torch.zeros_like(truth), spectral_target(scale * truth, fft_sizes=(512,), hops=(128,)))
    assert float(silence) == pytest.approx(1.0, rel=1e-4)


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
