"""Sounds that start at their peaks, as in the paper, beside those that start with the impact."""

from pathlib import Path

import numpy as np
import torch

from avmsf.capture import CaptureSettings, read_capture
from avmsf.capture.audio import Recording
from avmsf.capture.prepare import prepare
from factories.plate_capture import fill_plate

RATE = 8000.0


def recording() -> Recording:
    """Return 50 ms of silence, a small swing, and the largest sample 37 samples after it."""
    sound = np.zeros(4000)
    times = np.arange(3600)
    sound[400:] = 0.4 * np.exp(-times / 800) * np.cos(0.3 * times)
    sound[437] = -1.0
    return Recording("a.wav", sound[None], RATE, "FLOAT")


def test_a_sound_starts_at_its_largest_sample() -> None:
    onset, peak = (prepare(recording(), CaptureSettings(time_zero=name)) for name in ("onset", "peak"))
    assert abs(onset.onset - 400) <= 1
    assert peak.onset == 437
    assert peak.sound[0] == -1.0
    assert len(peak.sound) == 4000 - 437
    # Files that start where they start are not moved.
    assert len(prepare(recording(), CaptureSettings(time_zero="peak", align=False)).sound) == 4000


def test_recordings_from_their_peaks_are_final(tmp_path: Path) -> None:
    folder = fill_plate(tmp_path / "plate")
    impacts = read_capture(folder, CaptureSettings(time_zero="peak")).impacts
    assert impacts.before is None
    assert bool((impacts.sounds[:, 0].abs() == impacts.sounds.abs().amax(1)).all())
    assert not torch.equal(read_capture(folder, CaptureSettings()).impacts.sounds, impacts.sounds)


def test_settings_start_where_they_are_asked_to() -> None:
    own = CaptureSettings(align=False)
    assert own.starting(None) == own.starting("onset") == own
    assert own.starting("peak").from_peaks
    assert not own.starting("peak").starting("onset").from_peaks
