"""Sound files and their channels."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.capture import CaptureSettings, check, read_capture, read_recording
from avmsf.capture.audio import clipped_samples, constant_offset
from avmsf.capture.issues import shared_problems
from avmsf.errors import CaptureWarning
from factories.capture_folder import RATE, fill, ring

NAMES = ("a.wav", "b.wav", "c.wav")


def test_channels_are_counted_from_one(tmp_path: Path) -> None:
    both = np.stack([ring(seed=0), ring(seed=1)], axis=1)
    folder = fill(tmp_path, replace=dict.fromkeys(NAMES, both))
    for channel in (1, 2):
        sounds = read_capture(folder, CaptureSettings(response_channel=channel, align=False)).impacts.sounds
        assert torch.equal(sounds[0], torch.from_numpy(both[:, channel - 1].astype(np.float32)))


def test_integer_samples_become_fractions_of_full_scale(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "half.wav", np.array([0, 16384, -32768], dtype=np.int16), 48_000)
    assert read_recording(tmp_path / "half.wav").channel(1).tolist() == [0, 0.5, -1]


@pytest.mark.parametrize(
    ("container", "subtype", "problems"),
    [
        ("WAV", "PCM_U8", 1),
        ("WAV", "IMA_ADPCM", 1),
        ("WAV", "MS_ADPCM", 1),
        ("OGG", "VORBIS", 1),
        ("MP3", "MPEG_LAYER_III", 1),
        ("FLAC", "PCM_16", 0),
        ("WAV", "PCM_24", 0),
        ("CAF", "ALAC_16", 0),
    ],
)
def test_loss_by_compression_or_8_bits_is_reported(tmp_path: Path, container: str, subtype: str, problems: int) -> None:
    fill(tmp_path)
    soundfile.write(tmp_path / "b.wav", ring(), RATE, format=container, subtype=subtype)
    report = check(tmp_path).recordings[1]
    assert (report.coding, report.clipped, len(report.problems)) == (subtype, 0, problems)


@pytest.mark.parametrize("frequency", [20.0, 25.0, 33.0, 33.3, 50.0, 66.6])
def test_a_slow_vibration_is_no_offset_and_hides_none(frequency: float) -> None:
    time = np.arange(48_000) / 48_000
    noise = 1e-4 * np.random.default_rng(0).standard_normal(48_000)
    sound = np.exp(-time) * np.sin(2 * np.pi * frequency * time) + noise
    assert constant_offset(sound, sample_rate=48_000) == 0.0
    quiet = np.concatenate([noise, sound]) + 0.01
    assert constant_offset(quiet, sample_rate=48_000) == pytest.approx(0.01, abs=1e-4)


def test_flat_tops_count_and_smooth_ones_do_not() -> None:
    time = np.arange(4000) / RATE
    wave = np.sin(2 * np.pi * 440 * time) * np.exp(-3 * time)
    clipped = np.clip(3 * wave, -1, 1)
    assert clipped_samples(wave) == 0
    assert clipped_samples(clipped) == np.sum(np.abs(clipped) == 1) > 1000
    # Turned down after clipping, the tops of one or two samples are not told from chance, all others are.
    assert 0.8 < clipped_samples(0.3 * clipped) / clipped_samples(clipped) <= 1
    # A soft 20 Hz wave rounded to 16 bits has one flat top of many samples, and is not clipped.
    slow = np.round(1000 * np.sin(2 * np.pi * 20 * time) * np.exp(-30 * time)) / 32768
    assert clipped_samples(slow) == 0


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
