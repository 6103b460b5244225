"""Noise of a residual: the stored sequence, filtered and white noise, and sounds whose noise is known."""

import math

import pytest
import torch

from avmsf.modal.residual_noise import (
    MEDIAN_LEVEL,
    PERIOD,
    estimate_residual,
    low_fluctuation_noise,
    noise_power,
    shape_noise,
    white_sequence,
)
from oracles.fluctuation import FFT_SIZES, fluctuation


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_spectrum_follows_the_magnitude():
    magnitude = torch.tensor([0.0, 2.0, 1.0, 0.1, 4.0])
    samples = 32768
    noise = shape_noise(magnitude, contacts=64, samples=samples, generator=seeded())
    power = torch.fft.rfft(noise).abs().square().mean(0) / samples
    place = torch.linspace(0, 4, samples // 2 + 1)
    left = place.floor().long().clamp_max(3)
    expected = magnitude[left] + (place - left) * (magnitude[left + 1] - magnitude[left])
    narrow = power[:16384].reshape(64, 256).mean(1).sqrt()
    wanted = expected[:16384].square().reshape(64, 256).mean(1).sqrt()
    # 64 contacts x 256 bins: the root of the power scatters by .4 %.
    torch.testing.assert_close(narrow, wanted, rtol=0.02, atol=0)


@pytest.mark.parametrize(
    "sound",
    [
        lambda magnitude: shape_noise(magnitude, contacts=2, samples=100, generator=seeded(1)).square().mean(1),
        lambda magnitude: low_fluctuation_noise(magnitude, samples=50),
    ],
)
def test_gradient_reaches_the_magnitude(sound):
    magnitude = torch.rand(7, generator=seeded(), dtype=torch.float64).requires_grad_()
    # White noise is float32, its level is linear in it: gradcheck's differences are exact to float32's rounding.
    assert torch.autograd.gradcheck(sound, [magnitude], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(("samples", "bins"), [(600, 9), (4800, 33), (24000, 257), (48000, 513)])
def test_white_noise_has_its_variance_in_every_band(samples: int, bins: int):
    sounds = 3.0 * torch.randn(12, samples, generator=seeded(2))
    power = noise_power(sounds, bins=bins)
    assert power.shape == (12, bins)
    assert abs(10 * math.log10(float(power.mean()) / 9.0)) < 0.5  # dB


def ringing(contacts: int, samples: int = 16000) -> torch.Tensor:
    """Return two decaying modes, a second at 16 kHz, the slower of which falls by 104 dB."""
    times = torch.arange(samples) / 16000.0
    modes = sum(
        torch.exp(-rate * times) * torch.sin(2 * math.pi * pitch * times) for pitch, rate in ((900, 12), (5000, 40))
    )
    return modes.expand(contacts, -1)


@pytest.mark.parametrize("contacts", [1, 10])
def test_residual_of_sounds_with_modes_has_the_level_of_their_noise(contacts: int):
    level = 0.003
    modes = ringing(contacts)
    sounds = modes + level * torch.randn(contacts, 16000, generator=seeded())
    decibels = 20 * torch.log10(estimate_residual(sounds, modes, bins=129).magnitude / level)
    # The logarithm of one exponential power scatters by 5.6 dB. A band has 32 of them a contact, of which
    # half-overlapping frames repeat a third: 1.2 dB at one contact, .4 dB at ten. 129 bands average that.
    assert abs(float(decibels.mean())) < 4 * 1.2 / math.sqrt(129 * contacts)
    assert float(decibels.std()) < 1.6 * 1.2 / math.sqrt(contacts)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0])
def test_residual_beneath_steady_tones_has_the_level_of_the_noise(ratio: float):
    """Modes as strong as the noise everywhere, of the right power and of unknown phase."""
    level = 0.1
    modes = ratio * level * torch.randn(20, 16000, generator=seeded(7))
    sounds = modes + level * torch.randn(20, 16000, generator=seeded(8))
    decibels = 20 * torch.log10(estimate_residual(sounds, -modes, bins=65).magnitude / level)
    # A share n / (n + S) of each log power speaks of the noise: 1 % of it at a ratio of 10.
    assert abs(float(decibels.mean())) < 0.15 * (1 + ratio)


def test_residual_is_hardly_raised_by_what_modes_leave_over():
    # The modes are 1 % wrong, and a mode that was not found falls by 35 dB. In the last quarter it is a line 26 dB
    # above the noise's density.
    level = 0.003
    noise = level * torch.randn(10, 16000, generator=seeded())
    times = torch.arange(16000) / 16000.0
    missed = 0.1 * torch.exp(-4 * times) * torch.sin(2 * math.pi * 3100 * times)
    sounds = 1.01 * ringing(10) + missed + noise
    decibels = 20 * torch.log10(estimate_residual(sounds, ringing(10), bins=129).magnitude / level)
    assert abs(float(decibels.median())) < 0.2
    # The line is in 3 of its band's 8 frequencies: 3/8 of 26 dB. In all others nothing is left of it.
    assert float(decibels.max()) < 12.0
    assert int((decibels > 1.5).sum()) == 1
    # Its power is spread over the band by the mean of the lowest-energy segments.
    lowest = 10 * torch.log10(noise_power(sounds - ringing(10), bins=129).mean(0) / level**2)
    assert float(lowest.max()) > 16.0


def test_residual_renders_with_the_spectrum_it_was_estimated_from():
    magnitude = torch.linspace(2.0, 0.5, 33)
    recorded = shape_noise(magnitude, contacts=16, samples=32000, generator=seeded(3))
    found = estimate_residual(recorded, torch.zeros_like(recorded), bins=33)
    assert float((20 * torch.log10(found.magnitude / magnitude)).abs().max()) < 1.0  # dB


def test_sounds_that_are_their_modes_alone_leave_next_to_no_residual():
    # 120 dB below the modes' first swing.
    assert float(estimate_residual(ringing(3), ringing(3), bins=129).magnitude.max()) < 1e-6
    silence = torch.zeros(3, 16000)
    assert float(estimate_residual(silence, silence, bins=129).magnitude.max()) == 0.0


def test_the_sequence_fluctuates_half_as_much_as_gaussian_noise():
    assert float(fluctuation(white_sequence())) < 0.25
    # Closed form: E|m / median - 1| of the Rayleigh distribution is .4456; 2^17 samples tell it to about .5 %.
    assert float(fluctuation(torch.randn(PERIOD, generator=seeded(1)))) == pytest.approx(0.4456, abs=0.004)


def test_the_median_magnitude_of_the_sequence_is_that_of_gaussian_noise_at_its_level():
    for size in FFT_SIZES:
        window = torch.hann_window(size)
        magnitudes = torch.fft.rfft(MEDIAN_LEVEL * white_sequence().unfold(0, size, size // 4) * window)[:, 1:-1].abs()
        median = float((window.square().sum() * math.log(2)).sqrt())
        assert float(magnitudes.median()) == pytest.approx(median, rel=0.01)


def test_the_sequence_is_white_at_its_level():
    sequence = white_sequence()
    assert sequence.shape == (PERIOD,)
    assert float(sequence.square().mean().sqrt()) == pytest.approx(0.78, abs=0.005)
    power = torch.fft.rfft(sequence).abs().square()[1:-1] / PERIOD
    bands = power[: 64 * 1023].view(64, 1023).mean(1)
    # The power of 1023 random bins scatters by 3 %.
    torch.testing.assert_close(bands / bands.mean(), torch.ones(64), rtol=0.1, atol=0)
    autocorrelation = torch.fft.irfft(torch.fft.rfft(sequence).abs().square(), n=PERIOD)
    # Within a window it is that of a random sequence, which scatters by 1 / sqrt(2^17) = .0028, and a little more.
    assert float(autocorrelation[1:2048].abs().max() / autocorrelation[0]) < 0.03


def test_the_spectrum_follows_the_magnitude():
    magnitude = torch.tensor([0.0, 2.0, 1.0, 0.1, 4.0], dtype=torch.float64)
    noise = low_fluctuation_noise(magnitude, samples=PERIOD)
    # Halfway between two bins and on each: the ratio of the spectra is exact, for one period is filtered circularly.
    ratio = torch.fft.rfft(noise) / torch.fft.rfft(white_sequence().double())
    expected = torch.tensor([0.0, 1.0, 2.0, 1.5, 1.0, 0.55, 0.1, 2.05, 4.0], dtype=torch.float64)
    torch.testing.assert_close(ratio[:: PERIOD // 16].real, expected, rtol=0, atol=1e-9)
    assert float(ratio.imag.abs().max()) < 1e-9


@pytest.mark.parametrize("samples", [1, 1024, 30_011, PERIOD, PERIOD + 1, 3 * PERIOD - 5])
def test_any_length_is_cut_from_one_periodic_sound(samples: int):
    magnitude = torch.tensor([1.0, 0.1, 0.5])
    noise, longest = (low_fluctuation_noise(magnitude, samples=each) for each in (samples, 3 * PERIOD))
    assert noise.shape == (samples,)
    assert torch.equal(noise, longest[:samples])
    assert torch.equal(longest[:PERIOD], longest[-PERIOD:])
