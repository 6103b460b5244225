"""Recordings and tables out of bounds are named by `check` and refused by `read_capture`, whatever they hold."""

from pathlib import Path

import numpy as np
import pytest
import soundfile

from avmsf.capture import check, read_capture, read_recording
from avmsf.capture.audio import MAX_PEAK, MAX_SAMPLES, MIN_PEAK
from avmsf.capture.table import MAX_ROWS
from avmsf.errors import CaptureError
from factories.capture_folder import HEADER, RATE, ROWS, fill, ring
from factories.raising import raises


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


def test_a_force_cannot_lift_a_sound_beyond_float32(tmp_path: Path) -> None:
    rows = [f"{row},{newtons}" for row, newtons in zip(ROWS, ("1", "1", "1e-300"), strict=True)]
    report = check(fill(tmp_path, rows=rows, header=f"{HEADER},force_newtons"))
    assert [row.readable for row in report.recordings] == [True, True, False]
    assert "force_newtons" in report.recordings[2].problems[0]


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
    folder = fill(tmp_path, rows=(*ROWS, *(f"aa{number}.wav,0,0,0.1" for number in range(200))))
    report = check(folder)
    assert [row.readable for row in report.recordings] == [True] * 3 + [False] * 200
    assert all(row.problems for row in report.recordings[3:])
    assert len([problem for problem in report.problems if "200 of 203" in problem]) == 1
    with raises(CaptureError, file="impacts.csv", name="file", value=[f"aa{number}.wav" for number in range(200)]):
        read_capture(folder)


def test_a_table_of_too_many_rows_is_refused(tmp_path: Path) -> None:
    folder = fill(tmp_path, rows=[f"{number}.wav,0,0,0" for number in range(MAX_ROWS + 1)])
    report = check(folder)
    assert report.recordings == ()
    assert f"{MAX_ROWS:,}" in report.problems[0]
