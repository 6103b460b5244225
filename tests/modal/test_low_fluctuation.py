"""Noise of low fluctuation: the sequence that the package contains, and how it is filtered."""

import pytest
import torch

from avmsf.modal.residual_noise import PERIOD, low_fluctuation_noise, shape_noise, white_sequence
from oracles.fluctuation import fluctuation


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_sequence_fluctuates_half_as_much_as_gaussian_noise():
    assert float(fluctuation(white_sequence())) < 0.25
    # Closed form: E|m / median - 1| of the Rayleigh distribution is .4456; 2^17 samples tell it to about .5 %.
    assert float(fluctuation(torch.randn(PERIOD, generator=seeded(1)))) == pytest.approx(0.4456, abs=0.004)


@pytest.mark.parametrize("shift", [37, 64, 301])
def test_it_does_so_in_frames_that_begin_elsewhere(shift: int):
    assert float(fluctuation(white_sequence().roll(shift))) < 0.26


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


def test_a_median_magnitude_is_nearer_to_gaussian_noise_than_another_draw_is():
    """Of the mean magnitude: .586 for another draw, .419 for the median in every bin."""

    def magnitudes(sequence: torch.Tensor) -> torch.Tensor:
        return torch.stft(sequence, 1024, 256, window=torch.hann_window(1024), return_complex=True).abs()

    recorded, other = (torch.randn(PERIOD, generator=seeded(seed)) for seed in (3, 4))
    errors = [
        float((magnitudes(each) - magnitudes(recorded)).abs().mean() / magnitudes(recorded).mean())
        for each in (other, white_sequence())
    ]
    assert errors[0] == pytest.approx(0.586, abs=0.01)
    assert errors[1] < 0.5


def test_ones_give_the_sequence_itself():
    noise = low_fluctuation_noise(torch.ones(33), samples=PERIOD)
    # Two FFTs in float32.
    torch.testing.assert_close(noise, white_sequence(), rtol=0, atol=1e-5)


def test_the_spectrum_follows_the_magnitude():
    magnitude = torch.tensor([0.0, 2.0, 1.0, 0.1, 4.0], dtype=torch.float64)
    noise = low_fluctuation_noise(magnitude, samples=PERIOD)
    # Halfway between two bins and on each: the ratio of the spectra is exact, for one period is filtered circularly.
    ratio = torch.fft.rfft(noise) / torch.fft.rfft(white_sequence().double())
    expected = torch.tensor([0.0, 1.0, 2.0, 1.5, 1.0, 0.55, 0.1, 2.05, 4.0], dtype=torch.float64)
    torch.testing.assert_close(ratio[:: PERIOD // 16].real, expected, rtol=0, atol=1e-9)
    assert float(ratio.imag.abs().max()) < 1e-9


def test_it_is_filtered_as_gaussian_noise_is():
    magnitude = torch.tensor([3.0, 0.2, 1.0, 0.05, 2.0])
    drawn = shape_noise(magnitude, contacts=20, samples=PERIOD, generator=seeded())
    steady = low_fluctuation_noise(magnitude, samples=PERIOD)
    power = [torch.fft.rfft(each).abs().square()[..., 1:-1] for each in (drawn, steady)]
    bands = [each.reshape(-1, PERIOD // 2 - 1)[:, : 64 * 1023].mean(0).view(64, 1023).mean(1) for each in power]
    torch.testing.assert_close(bands[1] / bands[0], torch.full((64,), 0.782**2), rtol=0.12, atol=0)


@pytest.mark.parametrize("samples", [1, 1024, 30_011, PERIOD, PERIOD + 1, 3 * PERIOD - 5])
def test_any_length_is_cut_from_one_periodic_sound(samples: int):
    magnitude = torch.tensor([1.0, 0.1, 0.5])
    noise, longest = (low_fluctuation_noise(magnitude, samples=each) for each in (samples, 3 * PERIOD))
    assert noise.shape == (samples,)
    assert torch.equal(noise, longest[:samples])
    assert torch.equal(longest[:PERIOD], longest[-PERIOD:])


def test_no_click_where_the_sequence_repeats():
    # Low-passed, neighboring samples are alike; a sequence that was cut before filtering would jump here.
    magnitude = torch.cat([torch.ones(2), torch.zeros(63)])
    steps = low_fluctuation_noise(magnitude, samples=2 * PERIOD).diff().abs()
    assert float(steps[PERIOD - 1]) <= float(steps[: PERIOD - 1].max())
    around = steps[PERIOD - 20 : PERIOD + 20].mean()
    assert float(around) < 3 * float(steps.mean())


def test_gradient_reaches_the_magnitude():
    magnitude = torch.rand(7, generator=seeded(), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda each: low_fluctuation_noise(each, samples=50), [magnitude])
