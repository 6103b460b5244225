"""Sound files and their channels: every way in which one can be wrong is refused or warned of by name."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.capture import CaptureSettings, check, read_capture, read_recording
from avmsf.capture.audio import clipped_samples, constant_offset
from avmsf.capture.issues import shared_problems
from avmsf.errors import CaptureError, CaptureWarning
from factories.capture_folder import RATE, fill, ring
from factories.raising import raises, warns


def stereo() -> np.ndarray:
    return np.stack([ring(seed=0), ring(seed=1)], axis=1)


@pytest.mark.parametrize(
    ("samples", "settings", "name", "value"),
    [
        (np.zeros(4000), {}, None, 0.0),
        (np.full(4000, 0.25), {}, None, 0.25),
        (np.zeros(0), {}, None, 0),
        (np.where(np.arange(4000) == 7, np.nan, ring()), {}, None, 1),
        (ring(0.015), {}, "samples", 120),
        (np.linspace(-0.1, 0.1, 12), {"highpass": 20.0}, "samples", 12),
        (stereo(), {}, "response_channel", 2),
        (ring(), {"force_channel": 1}, "response_channel", 0),
        (np.stack([np.zeros(4000), ring()], axis=1), {"force_channel": 1}, "force_channel", 1),
        (ring(), {"normalize": "peak"}, "normalize", "peak"),
    ],
    ids=["silent", "constant", "empty", "nan", "short", "highpass", "stereo", "force alone", "no force", "no peak"],
)
def test_a_bad_recording_is_named(
    tmp_path: Path, samples: np.ndarray, settings: dict, name: str | None, value: float | str
) -> None:
    with raises(CaptureError, file="a.wav", name=name, value=value):
        read_capture(fill(tmp_path, replace={"a.wav": samples}), CaptureSettings(**settings))


def test_asking_for_less_than_modes_need_is_refused(tmp_path: Path) -> None:
    with raises(CaptureError, name="seconds", value=0.01):
        read_capture(fill(tmp_path), CaptureSettings(seconds=0.01))


@pytest.mark.parametrize(
    ("content", "name", "advice"),
    [
        (b"", "bytes", "export it again"),
        (b"not a wav at all", "bytes", "export it again"),
        (b"RIFF\x24\x00\x00\x00WAVEfmt ", "bytes", "export it again"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", None, "git lfs pull"),
    ],
)
def test_a_corrupt_file_is_named(tmp_path: Path, content: bytes, name: str | None, advice: str) -> None:
    folder = fill(tmp_path)
    (folder / "b.wav").write_bytes(content)
    with raises(CaptureError, file="b.wav", name=name) as caught:
        read_capture(folder)
    assert advice in str(caught.value)


def test_a_missing_file_is_named_and_guessed(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    (folder / "b.wav").rename(folder / "b1.wav")
    with raises(CaptureError, file="b.wav", value="b1.wav"):
        read_capture(folder)
    # A recording with a row of its own is of another contact.
    for others, value in ((("a.wav", "b1.wav"), "c.wav"), (("a.wav", "b1.wav", "c.wav"), None)):
        fill(tmp_path, rows=[f"{name},0,0,0" for name in (*others, "d.wav")])
        (folder / "b.wav").unlink()
        with raises(CaptureError, file="d.wav", value=value):
            read_capture(folder)
    (folder / "040.wav").write_bytes((folder / "a.wav").read_bytes())
    for missing, near in (("005.wav", None), ("40.wav", "040.wav")):
        fill(tmp_path, rows=("a.wav,0,0,0", f"{missing},1,0,0"))
        with raises(CaptureError, file=missing, value=near):
            read_capture(folder)
    fill(tmp_path, rows=("a.wav,0,0,0", "takes/b.wav,1,0,0"))
    with raises(CaptureError, file="takes/b.wav", value=None):
        read_capture(folder)
    (folder / "takes").mkdir()
    (folder / "takes" / "hammer on rim.wav").write_bytes((folder / "a.wav").read_bytes())
    for rows, below in ((("a.wav,0,0,0",), "takes/hammer on rim.wav"), (("takes/hammer on rim.wav,0,0,0",), None)):
        fill(tmp_path, rows=(*rows, "hammer on rim.wav,1,0,0"))
        with raises(CaptureError, file="hammer on rim.wav", value=below):
            read_capture(folder)


def test_a_sound_file_of_no_capture_is_guessed_too(tmp_path: Path) -> None:
    fill(tmp_path)
    for name, near in (("other.wav", None), ("aa.wav", "a.wav"), ("takes/a.wav", None)):
        with raises(CaptureError, file=tmp_path / name, value=near):
            read_recording(tmp_path / name)


def test_mixed_rates_are_refused_with_their_counts(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    soundfile.write(folder / "c.wav", ring(), RATE + 1)
    with raises(CaptureError, name="sample_rate", value=[RATE, RATE + 1]):
        read_capture(folder)


@pytest.mark.parametrize("rate", [100, 512, 192_000])
def test_any_rate_from_100_hz_to_192_khz_is_kept(tmp_path: Path, rate: int) -> None:
    seconds = max(1.0, 200 / rate)
    sounds = {name: ring(seconds, rate=rate, seed=seed) for seed, name in enumerate(("a.wav", "b.wav", "c.wav"))}
    folder = fill(tmp_path, replace=sounds, rate=rate)
    impacts = read_capture(folder, CaptureSettings(align=False)).impacts
    assert impacts.sample_rate == rate
    assert torch.equal(impacts.sounds[1], torch.from_numpy(sounds["b.wav"].astype(np.float32)))


@pytest.mark.parametrize(("rate", "speed"), [(99, 1.0), (192_001, 1.0), (8000, 30.0), (8000, 0.01)])
def test_other_rates_are_refused(tmp_path: Path, rate: int, speed: float) -> None:
    folder = fill(tmp_path, rate=rate)
    with raises(CaptureError, file="a.wav", name="sample_rate", value=rate * speed):
        read_capture(folder, CaptureSettings(playback_speed=speed))


def test_channels_are_counted_from_one(tmp_path: Path) -> None:
    both = stereo()
    folder = fill(tmp_path, replace={"a.wav": both, "b.wav": both, "c.wav": both})
    for channel in (1, 2):
        sounds = read_capture(folder, CaptureSettings(response_channel=channel, align=False)).impacts.sounds
        assert torch.equal(sounds[0], torch.from_numpy(both[:, channel - 1].astype(np.float32)))
    for channel in (0, 3):
        with raises(CaptureError, file="a.wav", name="channel", value=channel):
            read_recording(folder / "a.wav").response(channel)


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


@pytest.mark.parametrize(
    ("sound", "subtype", "figure", "low", "high"),
    [
        (np.clip(8 * ring(), -1, 1), "FLOAT", "clipped", 3, 4000),
        (0.01 * np.random.default_rng(0).standard_normal(4000), "FLOAT", "noise_db", -20, -10),
        (ring(noise=0) / 500, "PCM_16", "peak_db", -70, -60),
    ],
    ids=["clipped", "noise", "soft"],
)
def test_a_doubtful_recording_is_read_with_a_warning(
    tmp_path: Path, sound: np.ndarray, subtype: str, figure: str, low: float, high: float
) -> None:
    settings = CaptureSettings(seconds=0.1)
    with warns(CaptureWarning, file=tmp_path, value=["b.wav"]):
        read_capture(fill(tmp_path, subtype=subtype, replace={"b.wav": sound}), settings)
    report = check(tmp_path, settings).recordings[1]
    assert low < getattr(report, figure) < high
    assert len(report.problems) == 1


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


def test_integer_samples_become_fractions_of_full_scale(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "half.wav", np.array([0, 16384, -32768], dtype=np.int16), 48_000)
    assert read_recording(tmp_path / "half.wav").channel(1).tolist() == [0, 0.5, -1]


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
    files = {f"{number}.wav": ring(seed=number) for number in range(4)} | {"4.wav": np.clip(10 * ring(), -1, 1)}
    folder = fill(tmp_path, sounds=files, subtype="PCM_U8")
    sentences = shared_problems(check(folder).recordings)
    shared = [each for each in sentences if each.startswith("5 recordings (0.wav, 1.wav, 2.wav, …): ")]
    assert len(shared) == 1
    assert len([each for each in sentences if each.startswith("4.wav: ")]) == 1
    assert len(sentences) == 2


def test_a_recording_far_louder_than_all_others_is_named_and_a_fainter_one_is_not(tmp_path: Path) -> None:
    sounds = {f"{number}.wav": ring(seed=number) for number in range(7)}
    for factor, named in ((0.1, 0), (10.0, 1)):
        folder = fill(tmp_path / str(factor), sounds=sounds | {"2.wav": factor * sounds["2.wav"]})
        assert len([each for each in check(folder).problems if each.startswith("2.wav")]) == named


def test_noise_is_measured_in_what_the_settings_leave(tmp_path: Path) -> None:
    time = np.arange(8000) / 8000
    rumble = 0.05 * np.sin(2 * np.pi * 11 * time)
    sounds = {name: ring(1.0, before=0.4, seed=seed) + rumble for seed, name in enumerate(NAMES)}
    folder = fill(tmp_path, replace=sounds)
    plain, filtered = (check(folder, CaptureSettings(highpass=each)).recordings[0] for each in (0.0, 60.0))
    assert filtered.noise_db < plain.noise_db - 15
