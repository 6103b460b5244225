"""The paper's extraction against torch's own inverse transform and against single tones."""

import math

import pytest
import torch
from torch import Tensor

from avmsf.modal.extraction.stft import ShortTime, narrow_band
from avmsf.modal.modes import ModalBank

RATE = 16000.0


def tone(frequency: float, damping: float, *, gain: float = 1.0, seconds: float = 0.5, start: float = 0.0) -> Tensor:
    times = torch.arange(round(seconds * RATE)) / RATE - start
    return gain * (times >= 0) * torch.exp(-damping * times.clamp_min(0)) * torch.sin(2 * math.pi * frequency * times)


def find(sounds: Tensor, *, latest_peak: float = 0.1, least_damping: float = 0.5, count: int = 20) -> ModalBank:
    return ShortTime(count, 512 / RATE, 32 / RATE, latest_peak, least_damping).find(sounds, RATE)


@pytest.mark.parametrize("chosen", [1, 9, 31])
def test_a_bin_is_its_own_inverse_transform(chosen: int):
    fft_size, hop = 64, 8
    sounds = torch.randn(2, 800, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    window = torch.hann_window(fft_size, dtype=torch.float64)
    spectrum = torch.stft(sounds, fft_size, hop, window=window, pad_mode="constant", return_complex=True)
    alone = torch.zeros_like(spectrum)
    alone[:, chosen] = spectrum[:, chosen]
    sound = torch.istft(alone, fft_size, hop, window=window, length=800)
    found = narrow_band(sounds, fft_size=fft_size, hop=hop, bins=torch.tensor([chosen]))[:, 0, :-1].real
    # Away from the ends, where istft divides by fewer windows.
    inside = slice(fft_size // hop, -fft_size // hop)
    torch.testing.assert_close(found[:, inside], sound[:, ::hop][:, inside], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("frequency", "damping"), [(1000.0, 10.0), (3012.3, 25.0), (7000.7, 3.0)])
def test_a_clean_mode_is_measured(frequency: float, damping: float):
    bank = find(torch.stack([tone(frequency, damping), tone(frequency, damping, gain=0.3)]))
    strongest = int((bank.frequency - frequency).abs().argmin())
    assert len(bank) == 1
    # A bin is 31 Hz wide: the phase's slope tells a thousandth of that. The line through the logarithm is exact but for
    # the window straddling the onset and the end.
    assert float(bank.frequency[strongest]) == pytest.approx(frequency, abs=0.03)
    assert float(bank.damping[strongest]) == pytest.approx(damping, rel=0.02)


def test_what_begins_late_is_no_mode():
    # Raised slowly, for an edge would be a click in every bin.
    rise = torch.clamp((torch.arange(8000) / RATE - 0.15) / 0.05, 0, 1).square()
    late = rise * tone(3000.0, 20.0) * 50 + tone(1000.0, 20.0)
    pitches = find(torch.stack([late, late])).frequency
    assert pitches.tolist() == pytest.approx([1000.0], abs=0.1)
    assert len(find(torch.stack([late, late]), latest_peak=0.3)) == 2


def test_what_hardly_decays_is_hum():
    humming = tone(3000.0, 4.0) + tone(1000.0, 20.0)
    assert find(torch.stack([humming] * 2), least_damping=6.0).frequency.tolist() == pytest.approx([1000.0], abs=0.1)
    assert len(find(torch.stack([humming] * 2), least_damping=2.0)) == 2


def test_half_the_rate_is_no_mode():
    # By the gains' rounding, its frequency came out below half the rate now and then; a sine's samples are all zero.
    samples = torch.arange(8000, dtype=torch.float64)
    highest = torch.exp(-20.0 * samples / RATE) * (1 - 2 * (samples % 2))
    for seed in range(8):
        gains = torch.rand(5, 1, generator=torch.Generator().manual_seed(seed))
        found = find((gains * highest).float() + 0.3 * tone(1000.0, 20.0)).frequency
        assert found.tolist() == pytest.approx([1000.0], abs=0.1)


@pytest.mark.parametrize(("showing", "expected"), [(1, 1), (2, 1), (3, 2), (5, 2)])
def test_a_mode_must_show_in_half_the_recordings(showing: int, expected: int):
    sounds = [tone(1000.0, 20.0) + (tone(3000.0, 15.0) if row < showing else 0.0) for row in range(5)]
    assert len(find(torch.stack(sounds))) == expected


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_chance_brings_hardly_a_mode_about(seed: int):
    """Clicks of decaying noise are full of local maxima, of which half of the recordings always have one nearby."""
    generator = torch.Generator().manual_seed(seed)
    clicks = 0.1 * torch.randn(8, 8000, generator=generator) * torch.exp(-10.0 * torch.arange(8000) / RATE)
    assert len(find(clicks)) <= 2
    modes = find(clicks + torch.stack([tone(1000.0, 20.0) + tone(3000.0, 15.0)] * 8), count=100).frequency
    assert len(modes) <= 4
    for frequency in (1000.0, 3000.0):
        assert float((modes - frequency).abs().min()) < 1.0


def test_a_single_recording_has_nothing_to_agree_with():
    sounds = torch.stack([tone(1000.0, 20.0) + tone(3000.0, 15.0)])
    assert find(sounds).frequency.tolist() == pytest.approx([1000.0, 3000.0], abs=0.1)


def test_the_strongest_are_kept():
    sounds = torch.stack([sum(tone(1000.0 * k, 20.0, gain=0.5**k) for k in range(1, 6))] * 2)
    pitches = find(sounds, count=2).frequency.tolist()
    assert pitches == pytest.approx([1000.0, 2000.0], abs=0.5)


@pytest.mark.parametrize("scale", [100 / RATE, 400 / RATE, 12.0])
def test_any_rate_finds_the_same_in_samples(scale: float):
    sounds = torch.stack([tone(1000.0, 10.0) + tone(3012.0, 25.0)] * 2)
    near, rate = find(sounds), RATE * scale
    method = ShortTime(fft_seconds=512 / rate, hop_seconds=32 / rate, latest_peak=0.1 / scale, least_damping=scale / 2)
    far = method.find(sounds, rate)
    torch.testing.assert_close(far.frequency, near.frequency * scale, rtol=1e-6, atol=0)
    torch.testing.assert_close(far.damping, near.damping * scale, rtol=1e-6, atol=0)
