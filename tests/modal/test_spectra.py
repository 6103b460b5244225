"""Spectra against direct sums, scipy and closed forms."""

import math

import numpy as np
import pytest
import scipy.signal
import torch

from avmsf.errors import ArrayError
from avmsf.modal.spectra import envelope, htk_filters, log_mel, magnitude_stft
from factories.raising import raises


def noise(rows: int, samples: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(rows, samples, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("samples", [1, 40, 200, 203])
def test_frames_are_direct_sums_over_centered_windows(samples):
    fft_size, hop = 64, 16
    sound = noise(1, samples)
    magnitudes = magnitude_stft(sound, fft_size=fft_size, hop=hop)
    assert magnitudes.shape == (1, 33, 1 + samples // hop)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(fft_size) / fft_size)
    padded = np.pad(sound[0].numpy(), fft_size // 2)
    for frame in range(magnitudes.shape[2]):
        direct = np.abs(np.fft.rfft(window * padded[frame * hop : frame * hop + fft_size]))
        # Rounding of a sum of 64 terms in float64.
        np.testing.assert_allclose(magnitudes[0, :, frame].numpy(), direct, rtol=0, atol=1e-12)


def test_gradients_are_finite_at_silence_and_right_elsewhere():
    silent = torch.zeros(2, 100, requires_grad=True)
    filters = htk_filters(8, fft_size=32, sample_rate=8000.0, lowest=0.0, highest=4000.0).float()
    total = magnitude_stft(silent, fft_size=32, hop=8).sum() + envelope(silent).sum()
    (total + log_mel(silent, filters, fft_size=32, hop=8, floor=1e-5).sum()).backward()
    assert silent.grad is not None
    assert torch.isfinite(silent.grad).all()
    sound = noise(1, 40).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: magnitude_stft(x, fft_size=16, hop=4), sound)
    assert torch.autograd.gradcheck(envelope, sound)


@pytest.mark.parametrize("samples", [1, 2, 99, 100])
def test_envelope_is_scipys(samples):
    sound = noise(3, samples)
    expected = np.abs(scipy.signal.hilbert(sound.numpy(), axis=1))
    np.testing.assert_allclose(envelope(sound).numpy(), expected, rtol=0, atol=1e-13)


def test_htk_filters_peak_at_even_mels_and_sum_to_one():
    sample_rate, fft_size = 16000.0, 4096
    filters = htk_filters(20, fft_size=fft_size, sample_rate=sample_rate, lowest=100.0, highest=7000.0)
    bins = np.arange(fft_size // 2 + 1) * sample_rate / fft_size
    mel = 2595 * np.log10(1 + bins[filters.argmax(dim=1).numpy()] / 700)
    low, high = (2595 * math.log10(1 + f / 700) for f in (100.0, 7000.0))
    step = (high - low) / 21
    # A peak is on the bin next to its edge: within half of 3.9 Hz, at most 3 mel at the lowest filter.
    np.testing.assert_allclose(mel, low + step * np.arange(1, 21), atol=3.0)
    # Neighboring triangles of height one over common edges add up to one between the first and the last peak.
    between = (bins > bins[filters[0].argmax()] + 4) & (bins < bins[filters[-1].argmax()] - 4)
    np.testing.assert_allclose(filters.sum(dim=0).numpy()[between], 1.0, atol=1e-12)
    assert float(filters[:, bins < 100].abs().sum()) == 0.0
    assert float(filters[:, bins > 7000].abs().sum()) == 0.0


def test_log_mel_is_a_logarithm_above_its_floor():
    filters = htk_filters(10, fft_size=128, sample_rate=8000.0, lowest=0.0, highest=4000.0)
    sound = noise(1, 2000)
    once = log_mel(sound, filters, fft_size=128, hop=32, floor=1e-9)
    tenfold = log_mel(10 * sound, filters, fft_size=128, hop=32, floor=1e-9)
    assert torch.allclose(tenfold - once, torch.tensor(math.log(10), dtype=torch.float64), atol=1e-12)
    silent = log_mel(0 * sound, filters, fft_size=128, hop=32, floor=1e-5)
    assert torch.allclose(silent, torch.tensor(math.log(1e-5), dtype=torch.float64), atol=1e-12)


def test_filters_refuse_a_band_or_a_count_that_the_fft_cannot_give():
    with raises(ArrayError, name="highest"):
        htk_filters(10, fft_size=512, sample_rate=8000.0, lowest=0.0, highest=5000.0)
    with raises(ArrayError, name="count"):
        htk_filters(80, fft_size=128, sample_rate=44100.0, lowest=0.0, highest=22050.0)
