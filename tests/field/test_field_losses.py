"""The spectral loss against torch's own transform and its automatic gradient."""

import math
from itertools import product

import pytest
import torch

from avmsf.field.losses import spectral_loss, spectral_target
from avmsf.field.training import TrainingRun
from avmsf.modal.spectra import magnitude_stft
from oracles.plain_training import STEPS, PlainRun, full_setting, start

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


def test_other_sounds_and_odd_transforms_are_refused():
    target = spectral_target(sounds(), fft_sizes=SIZES, hops=HOPS, samples=5000)
    # A beginning longer than the sound is the sound.
    assert target.samples == 1000
    for other in (sounds(2), sounds(samples=900)):
        with pytest.raises(ValueError):
            spectral_loss(other, target)
    with pytest.raises(ValueError):
        spectral_target(sounds(), fft_sizes=(64, 63), hops=(16, 16))


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
