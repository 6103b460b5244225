"""Files of several channels: one sound in all of them is read and named once, different sounds are refused once."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from avmsf.capture import CaptureSettings, check, read_capture
from avmsf.capture.measure import shared_problems
from avmsf.errors import CaptureError, CaptureWarning
from factories.capture_folder import fill, ring

NAMES = ("a.wav", "b.wav", "c.wav")


def second_channel(sound: np.ndarray, kind: str) -> np.ndarray:
    if kind == "factor":
        return -0.5 * sound
    if kind == "silent":
        return np.zeros_like(sound)
    # Rounded to 16 bits with triangular dither of its own.
    dither = np.random.default_rng(7).triangular(-1, 0, 1, len(sound))
    return np.round(sound * 32768 + dither) / 32768


@pytest.mark.parametrize(
    ("kind", "subtype"), [("factor", "FLOAT"), ("silent", "PCM_16"), ("dither", "PCM_16"), ("dither", "FLOAT")]
)
@pytest.mark.parametrize("louder", [0, 1])
def test_channels_of_one_sound_are_read_and_named_once(tmp_path: Path, kind: str, subtype: str, louder: int) -> None:
    files = {}
    for seed, name in enumerate(NAMES):
        sound = ring(noise=1e-3, seed=seed)
        channels = [1.01 * sound if kind == "dither" else sound, second_channel(sound, kind)]
        files[name] = np.stack(channels if louder == 0 else channels[::-1], axis=1)
    folder = fill(tmp_path, replace=files, subtype=subtype)
    settings = CaptureSettings(align=False)
    with pytest.warns(CaptureWarning) as caught:
        sounds = read_capture(folder, settings).impacts.sounds.numpy()
    assert len(caught) == 1
    # The same channel in every file, whatever their levels: the other may have the opposite sign. But not a silent one.
    used = louder if kind == "silent" else 0
    expected = np.stack([files[name][:, used] for name in NAMES])
    assert np.abs(sounds - expected).max() <= (2.0**-15 if subtype == "PCM_16" else 1e-7)
    assert len(shared_problems(check(folder, settings).recordings)) == 1
    # Chosen by the settings, there is nothing to say.
    chosen = CaptureSettings(align=False, response_channel=used + 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(read_capture(folder, chosen).impacts.sounds.numpy(), sounds)


def test_a_soft_recording_s_channels_differ_by_their_rounding_alone(tmp_path: Path) -> None:
    # Its peak is 40 steps of 16 bits, so that rounding is more than a hundredth of it.
    files = {}
    for seed, name in enumerate(NAMES):
        sound = ring(noise=0.0, seed=seed) * 80 / 32768
        files[name] = np.stack([sound, second_channel(sound, "dither")], axis=1)
    folder = fill(tmp_path, replace=files, subtype="PCM_16")
    assert all(row.readable for row in check(folder).recordings)


@pytest.mark.parametrize("kind", ["late", "other", "noisy"])
def test_different_channels_are_refused_once(tmp_path: Path, kind: str) -> None:
    files = {}
    for seed, name in enumerate(NAMES):
        sound = ring(seed=seed)
        other = {
            "late": np.roll(sound, 1),
            "other": ring(seed=seed + 10),
            "noisy": sound + 0.05 * np.std(sound) * np.random.default_rng(0).standard_normal(len(sound)),
        }[kind]
        files[name] = np.stack([sound, other], axis=1)
    folder = fill(tmp_path, replace=files)
    report = check(folder)
    assert not any(row.readable for row in report.recordings)
    assert len(shared_problems(report.recordings)) == 1
    with pytest.raises(CaptureError):
        read_capture(folder)


def test_what_some_recordings_share_is_said_once_with_their_names(tmp_path: Path) -> None:
    rows = [f"{number}.wav,0,0,{number}" for number in range(5)]
    files = {f"{number}.wav": ring(seed=number) for number in range(4)} | {"4.wav": np.clip(10 * ring(), -1, 1)}
    folder = fill(tmp_path, rows=rows, replace=files, subtype="PCM_U8")
    sentences = shared_problems(check(folder).recordings)
    shared = [each for each in sentences if each.startswith("5 recordings (0.wav, 1.wav, 2.wav, …): ")]
    assert len(shared) == 1
    assert len([each for each in sentences if each.startswith("4.wav: ")]) == 1
    assert len(sentences) == 2


def test_a_recording_far_louder_than_all_others_is_named_and_a_fainter_one_is_not(tmp_path: Path) -> None:
    sounds = {f"{number}.wav": ring(seed=number) for number in range(7)}
    rows = [f"{name},{number / 10},0,0" for number, name in enumerate(sounds)]
    fine = fill(tmp_path / "fine", rows=rows, replace=sounds | {"2.wav": 0.1 * sounds["2.wav"]})
    loud = fill(tmp_path / "loud", rows=rows, replace=sounds | {"2.wav": 10 * sounds["2.wav"]})
    fine_ones, loud_ones = (
        [each for each in check(folder).problems if each.startswith("2.wav")] for folder in (fine, loud)
    )
    assert fine_ones == []
    assert len(loud_ones) == 1


def test_noise_is_measured_in_what_the_settings_leave(tmp_path: Path) -> None:
    time = np.arange(8000) / 8000
    rumble = 0.05 * np.sin(2 * np.pi * 11 * time)
    sounds = {name: ring(1.0, before=0.4, seed=seed) + rumble for seed, name in enumerate(NAMES)}
    folder = fill(tmp_path, replace=sounds)
    plain, filtered = (check(folder, CaptureSettings(highpass=each)).recordings[0] for each in (0.0, 60.0))
    assert filtered.noise_db < plain.noise_db - 15
