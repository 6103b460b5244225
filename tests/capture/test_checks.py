"""Sound files, their channels, and what `check` measures: it goes on past every broken thing, and remarks on others."""

import json
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import soundfile
import trimesh

from avmsf.capture import CaptureSettings, check, read_capture, read_recording
from avmsf.capture.audio import Recording, clipped_samples, constant_offset
from avmsf.capture.checks import expect_held
from avmsf.capture.issues import shared_problems
from avmsf.capture.measure import prepare_single
from avmsf.errors import CaptureError, CaptureWarning
from factories.capture_folder import RATE, ROWS, fill, ring
from factories.looked_at import surface_of
from factories.raising import raises

NAMES = ("a.wav", "b.wav", "c.wav")


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


def test_a_good_folder_has_no_problem_and_true_figures(tmp_path: Path) -> None:
    sound = ring(1.0, before=0.25, noise=1e-3)
    folder = fill(tmp_path, replace={"a.wav": sound}, settings="seconds = 0.4")
    report = check(folder)
    assert report.readable
    assert report.problems == ()
    first = report.recordings[0]
    assert (first.file, first.line, first.readable, first.problems) == ("a.wav", 2, True, ())
    assert (first.seconds, first.sample_rate, first.channels, first.coding) == (1.0, RATE, 1, "FLOAT")
    assert first.peak_db == pytest.approx(20 * np.log10(np.abs(sound).max()), abs=1e-3)
    # The level of 1840 samples of noise is known to 20 / ln 10 / sqrt(2 x 1840) = .14 dB.
    assert first.noise_db == pytest.approx(20 * np.log10(1e-3 / np.abs(sound).max()), abs=0.5)
    # The fourth of a period of the lowest mode, 20 samples long.
    assert first.onset_seconds == pytest.approx(0.25, abs=5 / RATE)
    assert first.clipped == 0
    assert first.double_hit_seconds is None


def test_it_goes_on_past_everything_that_is_broken(tmp_path: Path) -> None:
    rows = (*ROWS, "gone.wav,0,0,0.1", "d.wav,0,0,0.1", "e.wav,0,0,0.2", "f.wav,0,left,0.1", "g.wav,0,0,0.15")
    clipped = np.clip(10 * ring(), -1, 1)
    double = ring(1.0) + np.concatenate([np.zeros(3200), ring(0.6, seed=9)])
    others = {"b.wav": clipped, "c.wav": double, "d.wav": np.zeros(4000), "f.wav": ring(), "STRAY.WAV": ring()}
    folder = fill(tmp_path / ".work" / "cup", rows=rows, replace=others)
    (folder / "e.wav").write_bytes(b"RIFF")
    # None of the capture's.
    for name in (".avmsf/removed/002-ac4f8f352f81.wav", "takes/.trash/001.wav", "._a.wav"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(folder / name, ring(), RATE)
    soundfile.write(folder / "g.wav", ring(), 2 * RATE)
    report = check(folder)
    assert not report.readable
    assert [row.line for row in report.recordings] == [2, 3, 4, 5, 6, 7, 8, 9]
    assert [row.readable for row in report.recordings] == [True, True, True, False, False, False, False, True]
    assert [len(row.problems) for row in report.recordings] == [0, 1, 1, 1, 1, 1, 1, 0]
    problems = {row.file: "; ".join(row.problems) for row in report.recordings}
    assert str(report.recordings[1].clipped) in problems["b.wav"]
    assert "0.39" in problems["c.wav"]
    assert "'left'" in problems["f.wav"]
    assert report.recordings[2].double_hit_seconds == pytest.approx(0.4, abs=0.01)
    rates, repeated, unlisted = report.problems
    assert problems["gone.wav"].startswith("gone.wav")
    assert "8000 Hz" in rates
    assert "5, 6" in repeated
    assert "STRAY.WAV" in unlisted
    assert "002" not in unlisted
    # What the command line prints as JSON.
    assert json.loads(json.dumps(asdict(report), allow_nan=False))["recordings"][1]["clipped"] > 3


def test_a_copy_is_named_with_its_source_and_what_differs_past_the_cut_is_none(tmp_path: Path) -> None:
    sound = ring(1.0, seed=2)
    later = sound + np.where(np.arange(len(sound)) == 6000, 1e-3, 0.0)
    for other, problems in ((sound, ["c.wav: the same sound as b.wav"]), (later, [])):
        folder = fill(tmp_path, replace={"b.wav": sound, "c.wav": other}, settings="seconds = 0.1")
        assert [problem.partition(", to")[0] for problem in check(folder).problems] == problems


@pytest.mark.parametrize("offset", [0.01, -0.1, 4.0])
def test_a_constant_offset_of_the_recorder_changes_nothing(tmp_path: Path, offset: float) -> None:
    sounds = {f"{seed}.wav": ring(before=0.1, seed=seed) for seed in range(6)}
    clean = read_capture(fill(tmp_path / "clean", sounds=sounds)).impacts
    moved = {name: sound + offset for name, sound in sounds.items()}
    read = read_capture(fill(tmp_path / "moved", sounds=moved)).impacts
    # The offset is estimated from the quietest 40 ms or more, whose noise is 1e-4, and samples are float32.
    np.testing.assert_allclose(read.sounds, clean.sounds, atol=2e-5)
    levels = [check(tmp_path / name).recordings[0] for name in ("clean", "moved")]
    for name in ("noise_db", "peak_db"):
        assert getattr(levels[1], name) == pytest.approx(getattr(levels[0], name), abs=0.2)


def test_a_single_sound_is_judged_without_the_rumble_that_settings_remove() -> None:
    time = np.arange(RATE) / RATE
    humming = 0.3 * np.sin(2 * np.pi * 50 * time) + 0.3 * ring(1.0, before=0.5)
    hit = Recording("hit.wav", humming[None], RATE, "FLOAT")
    with pytest.raises(CaptureError):
        prepare_single(hit, CaptureSettings())
    prepare_single(hit, CaptureSettings(highpass=100.0))


def test_rows_in_the_order_of_text_and_not_of_numbers_are_remarked_on(tmp_path: Path) -> None:
    names = [f"{number}.wav" for number in range(1, 11)]
    sounds = {name: ring(1.0, before=0.25, seed=row) for row, name in enumerate(names)}
    for way, remarked in ((sorted(names), True), (names, False), (names[::-1], False)):
        report = check(fill(tmp_path / f"{way[1]}{way[2]}", sounds={name: sounds[name] for name in way}))
        assert any("order of text" in each for each in report.remarks) is remarked


def test_a_point_far_from_the_object_does_not_hold_it() -> None:
    surface = surface_of(trimesh.creation.box((0.1, 0.1, 0.1)))
    expect_held([(0.0, 0.0, 0.05), (0.05, 0.0, 0.06)], surface)
    with raises(CaptureError, name="held", value=pytest.approx(0.95)):
        expect_held([(0.0, 0.0, 0.05), (0.0, 0.0, 1.0)], surface)


@pytest.mark.parametrize(("rate", "seconds"), [(48_000, 0.1), (48_000, 0.25), (2048, 0.9), (1000, 1.0)])
def test_an_offset_of_a_short_sound_is_found_and_none_is_seen_where_none_is(rate: int, seconds: float) -> None:
    time = np.arange(round(rate * seconds)) / rate
    noise = 1e-4 * np.random.default_rng(0).standard_normal(len(time))
    sound = np.exp(-20 / seconds * time) * np.sin(0.3 * np.pi * rate * time) + noise
    assert constant_offset(sound, sample_rate=rate) == 0.0
    assert constant_offset(sound + 0.05, sample_rate=rate) == pytest.approx(0.05, abs=2e-4)


def test_a_few_low_modes_are_no_offset_of_a_short_sound() -> None:
    generator, time = np.random.default_rng(1), np.arange(800) / 8000
    for _ in range(300):
        count = generator.integers(1, 5)
        frequency, damping = 100 * 20 ** generator.random(count), generator.uniform(5, 300, count)
        modes = np.exp(-damping[:, None] * time) * np.sin(2 * np.pi * frequency[:, None] * time)
        assert constant_offset(generator.standard_normal(count) @ modes, sample_rate=8000) == 0.0
