"""`check` goes on past every broken thing, measures what it can, and agrees with `read_capture` on what is readable."""

import json
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import soundfile

from avmsf.capture import CaptureSettings, check, read_capture, read_recording
from avmsf.capture.audio import MAX_PEAK, MAX_SAMPLES, MIN_PEAK
from avmsf.capture.issues import shared_problems
from avmsf.capture.proposals import propose_settings
from avmsf.capture.table import MAX_ROWS
from avmsf.errors import CaptureError
from factories.capture_folder import HEADER, RATE, ROWS, fill, ring
from factories.raising import raises


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


def test_noise_is_found_in_the_quietest_part_where_nothing_comes_before(tmp_path: Path) -> None:
    sound = ring(1.0, noise=1e-3)
    noise = check(fill(tmp_path, replace={"a.wav": sound})).recordings[0].noise_db
    # The quietest tenth of blocks of 80 samples lies 1.3 x 20 / ln 10 / sqrt(160) = .9 dB under the mean one.
    assert noise == pytest.approx(20 * np.log10(1e-3 / np.abs(sound).max()) - 0.9, abs=1)


def test_it_goes_on_past_everything_that_is_broken(tmp_path: Path) -> None:
    rows = (*ROWS, "gone.wav,0,0,0.1", "d.wav,0,0,0.1", "e.wav,0,0,0.2", "f.wav,0,left,0.1", "g.wav,0,0,0.15")
    clipped = np.clip(10 * ring(), -1, 1)
    double = ring(1.0) + np.concatenate([np.zeros(3200), ring(0.6, seed=9)])
    folder = fill(
        tmp_path,
        rows=rows,
        replace={"b.wav": clipped, "c.wav": double, "d.wav": np.zeros(4000), "f.wav": ring(), "stray.wav": ring()},
    )
    (folder / "e.wav").write_bytes(b"RIFF")
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
    assert "stray.wav" in unlisted
    # What the command line prints as JSON.
    assert json.loads(json.dumps(asdict(report), allow_nan=False))["recordings"][1]["clipped"] > 3


def test_wav_files_in_hidden_folders_are_none_of_the_captures(tmp_path: Path) -> None:
    folder = fill(tmp_path / ".work" / "cup")
    for name in (".avmsf/removed/002-ac4f8f352f81.wav", "takes/.trash/001.wav", "._a.wav", "takes/1.wav", "more.wav"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(folder / name, ring(), RATE)
    (unlisted,) = check(folder).problems
    assert "more.wav, takes/1.wav" in unlisted
    assert "002-ac4f8f352f81.wav" not in unlisted


BROKEN = [
    {},
    {"rows": ()},
    {"rows": (*ROWS, "a.wav,0,0,0")},
    {"rows": (*ROWS[:2], "c.wav,0,0.2,0")},
    {"rows": (*ROWS[:2], "c.wav,0,0,300")},
    {"rows": ROWS[:2], "header": "file,x,y"},
    {"replace": {"b.wav": np.zeros(0)}},
    {"replace": {"b.wav": np.stack([ring(), ring(seed=1)], axis=1)}},
    {"replace": {"b.wav": ring(0.015)}},
    {"replace": {"b.wav": np.clip(10 * ring(), -1, 1)}},
    {"subtype": "PCM_U8"},
    {"rate": 99},
    {"settings": "second = 1"},
    {"settings": "seconds = 0.001"},
    {"settings": 'surface = "no.obj"'},
    {"settings": 'normalize = "peak"'},
    {"settings": "force_channel = 2"},
]


@pytest.mark.parametrize("case", BROKEN, ids=[str(number) for number in range(len(BROKEN))])
def test_readable_means_that_it_can_be_read(tmp_path: Path, case: dict) -> None:
    folder = fill(tmp_path, **case)
    report = check(folder)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_capture(folder)
        readable = True
    except CaptureError:
        readable, caught = False, []
    assert report.readable == readable
    found = [*report.problems, *(problem for row in report.recordings for problem in row.problems)]
    assert bool(found) == (not readable or bool(caught))


def test_measured_strikes_pass(shared: Path) -> None:
    captures = Path(__file__).resolve().parents[2] / "benchmarks/captures"
    for name in ("aircraft", "aircraft_response"):
        report = check(shared / name, CaptureSettings.read(captures / f"{name}.toml"))
        assert report.readable
        # Two files of this measurement are the same, at contacts 112 mm apart.
        (problem,) = report.problems
        assert problem.split(", to")[0].replace("impacts/", "") == "017.wav: the same sound as 016.wav"
        assert len(report.recordings) == 74
        assert [row.problems for row in report.recordings] == [()] * 74


def test_contacts_too_far_away_share_one_message(tmp_path: Path) -> None:
    rows = (*ROWS[:1], "b.wav,0,200,0", "c.wav,0,0,-300")
    reports = check(fill(tmp_path / "two", rows=rows)).recordings
    assert [row.readable for row in reports] == [True, False, False]
    (line,) = shared_problems(reports)
    assert "-300" in line
    assert "of 2" in line


@pytest.mark.parametrize("names", ["abc", "abcdef"])
def test_recordings_in_a_subfolder_are_named(tmp_path: Path, names: str) -> None:
    rows = [f"{name}.wav,0.1,0,0.{place}" for place, name in enumerate(names, start=1)]
    sounds = {f"{name}.wav": ring() for name in names}
    folder = fill(tmp_path / "bowl", rows=rows, replace=sounds)
    (folder / "taps").mkdir()
    for name in sounds:
        (folder / name).rename(folder / "taps" / name)
    report = check(folder)
    assert not report.readable
    messages = [*report.problems, *(problem for row in report.recordings for problem in row.problems)]
    assert any("write taps/a.wav" in message for message in messages)
    with raises(CaptureError, name="file", value=list(sounds)) as caught:
        read_capture(folder)
    assert "write taps/a.wav" in str(caught.value)
    (folder / "impacts.csv").write_text("\n".join([HEADER, *(f"taps/{row}" for row in rows)]))
    assert check(folder).readable


def test_recordings_that_were_scaled_to_one_peak_are_named(tmp_path: Path) -> None:
    sounds = {f"{seed}.wav": ring(seed=seed) * (1 + seed) for seed in range(4)}
    assert check(fill(tmp_path / "as recorded", sounds=sounds)).problems == ()
    equal = {name: 0.9 * sound / np.abs(sound).max() for name, sound in sounds.items()}
    (problem,) = check(fill(tmp_path / "scaled", sounds=equal)).problems
    assert "same peak, 0.9" in problem


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


def test_sway_and_rumble_are_proposed_to_be_filtered_whatever_their_onset(tmp_path: Path) -> None:
    rate = 16_000
    time = np.arange(rate) / rate
    sway = 0.4 * np.sin(2 * np.pi * 8 * time + 1)
    sounds = {f"{seed}.wav": ring(1.0, rate=rate, before=0.3, seed=seed) + sway for seed in range(4)}
    proposed = {each.key: each.value for each in propose_settings(fill(tmp_path, sounds=sounds, rate=rate))}
    assert proposed == {"highpass": 20.0}


def test_rows_in_the_order_of_text_and_not_of_numbers_are_remarked_on(tmp_path: Path) -> None:
    names = [f"{number}.wav" for number in range(1, 11)]
    sounds = {name: ring(1.0, before=0.25, seed=row) for row, name in enumerate(names)}
    for way, remarked in ((sorted(names), True), (names, False), (names[::-1], False)):
        report = check(fill(tmp_path / f"{way[1]}{way[2]}", sounds={name: sounds[name] for name in way}))
        assert any("order of text" in each for each in report.remarks) is remarked


def click(height: float = 1.0) -> np.ndarray:
    sound = np.zeros(4000)
    sound[0] = height
    return sound


def test_a_click_before_digital_silence_is_one_blow(tmp_path: Path) -> None:
    report = check(fill(tmp_path, replace={"b.wav": click()}))
    assert [row.readable for row in report.recordings] == [True, True, True]
    assert report.recordings[1].double_hit_seconds is None


@pytest.mark.parametrize("height", [1e200, 1e40, 1e16, 1e-300, 1e-20])
def test_amplitudes_that_float32_cannot_compute_with_are_named(tmp_path: Path, height: float) -> None:
    assert not MIN_PEAK <= height <= MAX_PEAK
    folder = fill(tmp_path, replace={"b.wav": click(height), "c.wav": height * ring()}, subtype="DOUBLE")
    report = check(folder)
    assert [row.readable for row in report.recordings] == [True, False, False]
    assert f"{height:.3g}" in report.recordings[1].problems[0]
    with pytest.raises(CaptureError):
        read_capture(folder)


@pytest.mark.parametrize(("factor", "readable"), [(1e3, True), (1e5, True), (1e10, False), (1e-10, False)])
def test_a_recording_of_another_scale_is_named(tmp_path: Path, factor: float, readable: bool) -> None:
    folder = fill(tmp_path, replace={"b.wav": factor * ring(seed=1)})
    report = check(folder)
    named = [problem for problem in report.problems if "b.wav" in problem]
    # 1000 times is 60 dB, which the nodes of modes and soft blows explain.
    assert len(named) == (0 if factor == 1e3 else 1)
    assert report.readable == readable
    if not readable:
        with raises(CaptureError, file="b.wav", name="peak"):
            read_capture(folder)


def test_a_compressed_file_is_measured_by_its_header(tmp_path: Path) -> None:
    channels, name = 8, tmp_path / "silence.wav"
    with soundfile.SoundFile(name, "w", RATE, channels, subtype="PCM_16", format="FLAC") as file:
        for _ in range(17):
            file.write(np.zeros((MAX_SAMPLES // channels // 16, channels), dtype=np.int16))
    assert name.stat().st_size < 1e6
    with raises(CaptureError, file=name, value=17 * MAX_SAMPLES // 16):
        read_recording(name)


def test_many_missing_files_are_counted_once(tmp_path: Path) -> None:
    rows = [*ROWS, *(f"aa{number}.wav,0,0,0.1" for number in range(200))]
    # Each row has its report, also one that names a file again.
    assert [row.line for row in check(fill(tmp_path, rows=(*rows, rows[-1]))).recordings] == list(range(2, 206))
    folder = fill(tmp_path, rows=rows)
    report = check(folder)
    assert [row.readable for row in report.recordings] == [True] * 3 + [False] * 200
    (line,) = shared_problems(report.recordings)
    assert "200 of 203" in line
    assert not any("of 203" in problem for problem in report.problems)
    with raises(CaptureError, file="impacts.csv", name="file", value=[f"aa{number}.wav" for number in range(200)]):
        read_capture(folder)


def test_a_table_of_too_many_rows_is_refused(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=[f"{number}.wav,0,0,0" for number in range(MAX_ROWS + 1)])
    report = check(folder)
    assert report.recordings == ()
    assert f"{MAX_ROWS:,}" in report.problems[0]
