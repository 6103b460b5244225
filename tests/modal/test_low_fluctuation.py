"""Noise of low fluctuation: the sequence that the package contains, and how it is filtered."""

import pytest
import torch

from avmsf.modal.residual_noise import PERIOD, low_fluctuation_noise, white_sequence
from oracles.fluctuation import fluctuation


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_sequence_fluctuates_half_as_much_as_gaussian_noise():
    assert float(fluctuation(white_sequence())) < 0.25
    # Closed form: E|m / median - 1| of the Rayleigh distribution is .4456; 2^17 samples tell it to about .5 %.
    assert float(fluctuation(torch.randn(PERIOD, generator=seeded(1)))) == pytest.approx(0.4456, abs=0.004)


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


def test_gradient_reaches_the_magnitude():
    magnitude = torch.rand(7, generator=seeded(), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda each: low_fluctuation_noise(each, samples=50), [magnitude])
