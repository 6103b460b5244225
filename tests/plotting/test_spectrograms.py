"""Spectrograms of methods: the axes' limits, the sounds' scale and the tones' places are read from the figure."""

import math

import numpy as np
import pytest
import torch

from avmsf.plotting.spectrograms import draw_spectrograms, log_spectrogram

RATE = 44100.0


def tone(hertz: float, *, seconds: float = 1.5, rate: float = RATE) -> torch.Tensor:
    return torch.sin(2 * math.pi * hertz * torch.arange(round(seconds * rate), dtype=torch.float64) / rate)


def test_panels_show_20_hz_to_20_khz_of_the_first_second_with_every_method_in_its_column() -> None:
    sounds = {"recorded": tone(440), "field": tone(880), "knn3": tone(1760)}
    figure = draw_spectrograms(
        {"rim": sounds, "base": {"recorded": tone(220)}}, list(sounds), sample_rate=RATE, title="bowl"
    )
    panels = figure.axes[:6]
    assert [axes.get_title() for axes in panels[:3]] == ["recorded", "field", "knn3"]
    assert [axes.get_ylabel().splitlines()[0] for axes in (panels[0], panels[3])] == ["rim", "base"]
    for axes in panels:
        assert axes.get_yscale() == "log"
        assert axes.get_ylim() == pytest.approx((20.0, 20000.0))
        assert axes.get_xlim() == pytest.approx((0.0, 1.0))
    for axes, hertz in zip(panels[:4], (440, 880, 1760, 220), strict=True):
        (mesh,) = axes.collections
        corners = mesh.get_coordinates()
        levels = mesh.get_array()
        row = int(np.argmax(levels[:, levels.shape[1] // 2]))
        low, high = corners[row, 0, 1], corners[row + 1, 0, 1]
        # The highest bin, 21.5 Hz wide, and a cell of 4.4 %.
        assert low - 22 <= hertz <= high + 22
        # Frames are 4 ms apart.
        assert corners[0, -1, 0] == pytest.approx(1.0, abs=0.005)
    # No method but the recording has a sound at the base.
    assert [len(axes.collections) for axes in panels] == [1, 1, 1, 1, 0, 0]


def test_every_sound_is_scaled_to_a_peak_of_one() -> None:
    sounds = {"recorded": 0.01 * tone(440), "same": 7.0 * tone(440), "silent": 0.0 * tone(440)}
    figure = draw_spectrograms({"rim": sounds}, list(sounds), sample_rate=RATE, title="bowl")
    recorded, same, silent = (axes.collections[0].get_array() for axes in figure.axes[:3])
    assert recorded.max() == 0.0
    assert np.allclose(recorded, same, atol=1e-6)
    assert silent.max() < -80
    # Or all on the scale of the recording.
    figure = draw_spectrograms({"rim": sounds}, ["same", "recorded"], sample_rate=RATE, normalize=False, title="bowl")
    same, recorded = (axes.collections[0].get_array() for axes in figure.axes[:2])
    assert same.max() == 0.0
    assert recorded.max() == pytest.approx(20 * math.log10(0.01 / 7.0), abs=1e-4)


def test_slow_recordings_end_at_half_their_rate() -> None:
    # Kept sounds of slow recordings are resampled to a rate that browsers play.
    sounds = {"recorded": tone(100, seconds=0.5, rate=8000.0)}
    figure = draw_spectrograms({"wing": sounds}, ["recorded"], sample_rate=8000.0, highest=200.0, title="wing")
    axes = figure.axes[0]
    assert axes.get_ylim() == pytest.approx((4.0, 200.0))
    assert axes.get_xlim() == pytest.approx((0.0, 0.5))


def test_a_full_scale_sine_reads_a_quarter_of_the_fft_size() -> None:
    levels = log_spectrogram(tone(1000 * RATE / 44100), sample_rate=RATE, lowest=20.0, highest=20000.0)
    # A sine between two bins of a Hann window loses at most 1.42 dB.
    assert float(levels.max()) == pytest.approx(20 * math.log10(2048 / 4), abs=1.43)
