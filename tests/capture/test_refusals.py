"""What makes a folder no capture, and what makes it a doubtful one: `read_capture` names it, and `check` agrees."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
import trimesh

from avmsf._utils.text import MAX_TOML_BYTES
from avmsf.capture import CaptureSettings, check, read_capture, read_recording
from avmsf.capture.audio import MAX_SAMPLES
from avmsf.errors import CaptureError, CaptureWarning
from factories.capture_folder import HEADER, RATE, ROWS, fill, ring
from factories.raising import raises, warns

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
FORCES, DIRECTIONS = f"{HEADER},force_newtons", f"{HEADER},nx,ny,nz"
CLIPPED = np.clip(8 * ring(), -1, 1)
LEVELS = {f"{number}.wav": ring(seed=number) for number in range(7)}
NOISE = np.random.default_rng(0).standard_normal(4000)


def stereo(*channels: np.ndarray) -> np.ndarray:
    return np.stack(channels, axis=1)


def click(height: float) -> np.ndarray:
    return np.where(np.arange(4000) == 0, height, 0.0)


def box(size: float) -> bytes:
    return trimesh.creation.box((size, 2 * size, 3 * size)).export(file_type="ply")


RECORDINGS = [
    (np.zeros(4000), "", None, 0.0),
    (np.full(4000, 0.25), "", None, 0.25),
    (np.zeros(0), "", None, 0),
    (np.where(np.arange(4000) == 7, np.nan, ring()), "", None, 1),
    (ring(0.015), "", "samples", 120),
    (np.where(np.arange(4000) < 3900, 1e-4 * NOISE, np.roll(ring(), 3900)), "", "samples", pytest.approx(99, abs=3)),
    (np.linspace(-0.1, 0.1, 12), "highpass = 20", "samples", 12),
    (ring(), "highpass = 1.9", "highpass", 1.9),
    (ring(), "highpass = 4000", "highpass", 4000.0),
    (stereo(ring(), ring(seed=1)), "", "response_channel", 2),
    (stereo(ring(), ring() + 0.05 * np.std(ring()) * NOISE), "", "response_channel", 2),
    (stereo(ring(), ring()), "response_channel = 3", "channel", 3),
    (ring(), "force_channel = 1", "response_channel", 0),
    (stereo(np.zeros(4000), ring()), "force_channel = 1", "force_channel", 1),
    (ring(), 'normalize = "peak"', "normalize", "peak"),
    (ring(), "playback_speed = 30", "sample_rate", 240_000.0),
    (ring(), "playback_speed = 0.01", "sample_rate", 80.0),
    (b"", "", "bytes", 0),
    (b"RIFF\x24\x00\x00\x00WAVEfmt ", "", "bytes", 16),
    (LFS, "", None, None),
]
"""Recordings, with settings, and the name and value of the error."""

TABLES = [
    ("file,x,y", ("a.wav,0,0",), 1, "z", ["file", "x", "y"]),
    ("name,x,y", ("a.wav,0,0",), 1, "file", ["name", "x", "y"]),
    ("file,x,y,z,nx", ("a.wav,0,0,0,1",), None, "ny", ["nx"]),
    ("file,x,y,z,x", ("a.wav,0,0,0,1",), 1, "x", ["file", "x", "y", "z", "x"]),
    (HEADER, (), None, None, 0),
    ("", (), None, None, ""),
    (HEADER, ("a.wav,0.1,0", *ROWS[1:]), 2, "z", 3),
    (HEADER, (ROWS[0], "b.wav,0,nan,0", ROWS[2]), 3, "y", "nan"),
    (HEADER, (ROWS[0], "b.wav,0,,0", ROWS[2]), 3, "y", ""),
    (HEADER, (ROWS[0], ROWS[1], "c.wav,0,0,inf"), 4, "z", "inf"),
    ("# a bowl\n# in meters\nfile,x,y,z", (ROWS[0], "b.wav,0,0.2,?"), 5, "z", "?"),
    (HEADER, (ROWS[0], "b.wav,0,200,0"), 3, "unit", [0.0, 200.0, 0.0]),
    (HEADER, (ROWS[0], ",0,0.2,0"), 3, "file", ""),
    (HEADER, (ROWS[0], "../b.wav,0,0.2,0"), 3, "file", "../b.wav"),
    (HEADER, (ROWS[0], "/b.wav,0,0.2,0"), 3, "file", "/b.wav"),
    (HEADER, (ROWS[0], "C:\\b.wav,0,0.2,0"), 3, "file", "C:\\b.wav"),
    (HEADER, (ROWS[0], ROWS[1], "a.wav,0,0,1"), 4, "file", "a.wav"),
    (FORCES, ("a.wav,0,0,0,2", "b.wav,0,1,0,0"), 3, "force_newtons", 0.0),
    # A force so small would lift the sound beyond float32.
    (FORCES, ("a.wav,0,0,0,2", "b.wav,0,1,0,1e-300"), 3, "force_newtons", 1e-300),
    (
        HEADER,
        [*ROWS, *(f"aa{row}.wav,0,0,0.1" for row in range(200))],
        None,
        "file",
        [f"aa{n}.wav" for n in range(200)],
    ),
]
"""Headers and rows, and the row, name and value of the error."""

SETTINGS = [
    ("second = 2.0", "second", "second"),
    ('seconds = "3"', "seconds", "3"),
    ("seconds = true", "seconds", True),
    ("response_channel = 1.5", "response_channel", 1.5),
    ("align = 1", "align", 1),
    ("name = 3", "name", 3),
    ("seconds = 0", "seconds", 0.0),
    ("regularization = 0.0", "regularization", 0.0),
    ("playback_speed = -1", "playback_speed", -1.0),
    ("force_scale = 0", "force_scale", 0.0),
    ('unit = "km"', "unit", "km"),
    ('surface_unit = "yd"', "surface_unit", "yd"),
    ("force_channel = 0", "force_channel", 0),
    ("force_channel = 2\nresponse_channel = 2", "force_channel", 2),
    ('normalize = "rms"', "normalize", "rms"),
    ('normalize = "deconvolve"', "force_channel", None),
    ('time_zero = "middle"', "time_zero", "middle"),
    ("highpass = -1.0", "highpass", -1.0),
    ("held = [[0.0, 1.0]]", "held", [[0.0, 1.0]]),
    ("held = [[0, 0, inf]]", "held", ((0.0, 0.0, math.inf),)),
    ("seconds = ", None, None),
    (f"seconds = {10**400}", "seconds", 10**400),
    ("a = " + "[" * 3000 + "]" * 3000, None, None),
    ("#" * (MAX_TOML_BYTES + 1), None, None),
]
"""Texts of capture.toml, and the name and value of the error."""

IN_TAKES = {f"{name}.wav": None for name in "abc"} | {f"taps/{name}.wav": ring() for name in "abc"}
OTHERS: list[tuple[dict[str, Any], str | None, int | None, str | None, Any]] = [
    ({"rate": 99}, "a.wav", None, "sample_rate", 99.0),
    ({"rate": 192_001}, "a.wav", None, "sample_rate", 192_001.0),
    ({"settings": "seconds = 0.01"}, None, None, "seconds", 0.01),
    *(
        ({"replace": {"b.wav": click(height)}, "subtype": "DOUBLE"}, "b.wav", None, name, height)
        for height, name in ((1e200, None), (1e40, None), (1e16, None), (1e-300, "peak"), (1e-20, "peak"))
    ),
    ({"replace": {"impacts.csv": LFS}}, "impacts.csv", None, None, None),
    ({"replace": {"impacts.csv": "file,x,y,z\n\u00e4.wav,1,2,3\n".encode("utf-16")}}, "impacts.csv", None, None, None),
    ({"rows": ["a" * 200_000 + ".wav,0,0,0"]}, "impacts.csv", None, None, None),
    ({"settings": 'surface = "shell.obj"'}, "shell.obj", None, None, None),
    ({"settings": 'surface = "../shell.obj"'}, None, None, "surface", "../shell.obj"),
    ({"replace": {"surface.ply": b"ply\nnonsense"}}, "surface.ply", None, None, None),
    (
        {"rows": ("a.wav,15,0,0", "b.wav,0,0.2,0"), "replace": {"surface.ply": box(0.3)}},
        *("impacts.csv", 2, "surface", pytest.approx(14.85, abs=0.01)),
    ),
    ({"replace": {"surface.ply": box(200)}}, "impacts.csv", None, "unit", pytest.approx(99.9, rel=0.01)),
    # Another recording is proposed for one that is missing, unless it has a row of its own.
    ({"replace": {"b.wav": None, "b1.wav": ring()}}, "b.wav", None, None, "b1.wav"),
    ({"rows": (*ROWS[:2], "d.wav,0,0,0")}, "d.wav", None, None, "c.wav"),
    ({"rows": (*ROWS, "d.wav,0,0,0")}, "d.wav", None, None, None),
    ({"rows": (*ROWS, "005.wav,0,0,0"), "replace": {"040.wav": ring()}}, "005.wav", None, None, None),
    ({"rows": (*ROWS, "40.wav,0,0,0"), "replace": {"040.wav": ring()}}, "40.wav", None, None, "040.wav"),
    ({"rows": (*ROWS, "rim.wav,1,0,0"), "replace": {"takes/rim.wav": ring()}}, "rim.wav", None, None, "takes/rim.wav"),
    (
        {"rows": ("takes/rim.wav,0,0,0", "rim.wav,1,0,0"), "replace": {"takes/rim.wav": ring()}},
        *("rim.wav", None, None, None),
    ),
    ({"rows": ("a" * 300 + ".wav,0,0,0", *ROWS)}, "a" * 300 + ".wav", None, None, None),
    ({"replace": IN_TAKES}, None, None, "file", ["a.wav", "b.wav", "c.wav"]),
]
"""Folders, and the file, row, name and value of the error."""

REFUSED = [
    *(({"replace": {"a.wav": sound}, "settings": text}, "a.wav", None, *rest) for sound, text, *rest in RECORDINGS),
    *(({"header": header, "rows": rows}, "impacts.csv", *rest) for header, rows, *rest in TABLES),
    *(({"settings": text}, "capture.toml", None, *rest) for text, *rest in SETTINGS),
    *OTHERS,
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: "-".join(str(each)[:30] for each in case[1:]))
def test_a_folder_that_is_no_capture_is_refused_and_checked_as_unreadable(tmp_path: Path, case) -> None:
    folder, (file, row, name, value) = fill(tmp_path, **case[0]), case[1:]
    with raises(CaptureError, file=file, row=row, name=name, value=value):
        read_capture(folder)
    report = check(folder)
    assert not report.readable
    assert [*report.problems, *(problem for each in report.recordings for problem in each.problems)]


@pytest.mark.parametrize(
    ("case", "file", "row", "name", "value"),
    [
        ({"header": f"{HEADER},who", "rows": [f"{row},me" for row in ROWS]}, "impacts.csv", None, None, ["who"]),
        ({"rows": (*ROWS[:2], "c.wav,0,0.2,0")}, "impacts.csv", 4, None, [[3, 4]]),
        (
            {"rows": ("a.wav,10,0,0", "b.wav,0,20,0", ROWS[2])},
            *("impacts.csv", None, "unit", pytest.approx(math.hypot(10, 20, 0.3))),
        ),
        (
            {"rows": ("a.wav,0.0001,0,0", "b.wav,0,0.0002,0", "c.wav,0,0,0")},
            *("impacts.csv", None, "unit", pytest.approx(math.hypot(1, 2) * 1e-4)),
        ),
        ({"replace": {"b.wav": CLIPPED}}, None, None, None, ["b.wav"]),
        ({"replace": {"b.wav": 0.01 * NOISE}, "settings": "seconds = 0.1"}, None, None, None, ["b.wav"]),
        ({"replace": {"b.wav": ring(noise=0) / 500}, "subtype": "PCM_16"}, None, None, None, ["b.wav"]),
        ({"subtype": "PCM_U8"}, None, None, None, ["a.wav", "b.wav", "c.wav"]),
        ({"replace": {"b.wav": ring(0.2)}}, "b.wav", None, None, pytest.approx(0.2, abs=0.01)),
        ({"replace": {"b.wav": 1e5 * ring(seed=1)}}, "b.wav", None, "peak", pytest.approx(5e4, rel=0.5)),
        (
            {"sounds": {f"{n}.wav": ring(seed=n) * 10 ** (n == 2) for n in range(7)}},
            "2.wav",
            None,
            "peak",
            pytest.approx(4.7, rel=0.1),
        ),
        ({"sounds": {f"{n}.wav": 0.9 * ring() for n in range(4)}}, "0.wav", None, "peak", pytest.approx(0.4, rel=0.1)),
    ],
)
def test_a_doubtful_folder_is_read_with_a_warning(tmp_path: Path, case, file, row, name, value) -> None:
    folder = fill(tmp_path, **case)
    with warns(CaptureWarning, file=file, row=row, name=name, value=value):
        assert len(read_capture(folder).impacts) >= 3
    report = check(folder)
    assert report.readable
    assert [*report.problems, *(problem for each in report.recordings for problem in each.problems)]


@pytest.mark.parametrize(
    "case",
    [
        {},
        {"rows": (*ROWS[:2], "c.wav,0,0.201,0")},
        {"header": DIRECTIONS, "rows": ("a.wav,0.1,0,0,0,0,-1", "b.wav,0,0.2,0,0,0,-1", "c.wav,0,0.2,0,1,0,0")},
        # 60 dB, which the nodes of modes and soft impacts explain.
        {"replace": {"b.wav": 1e3 * ring(seed=1)}},
        {"sounds": LEVELS | {"2.wav": 0.1 * ring(seed=2)}},
        {"sounds": {f"{n}.wav": ring(seed=n) * (1 + n) for n in range(4)}},
        {"replace": {"b.wav": click(1.0)}},
    ],
    ids=["good", "close", "another direction", "louder", "fainter", "as recorded", "a click before digital silence"],
)
def test_what_is_no_mistake_is_read_in_silence(tmp_path: Path, case) -> None:
    folder = fill(tmp_path, **case)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # All are shorter than three seconds, and the first samples lie before the onset.
        assert 3990 <= read_capture(folder).impacts.sounds.shape[1] <= 4000
    report = check(folder)
    assert report.readable
    assert report.problems == ()
    assert [each.problems for each in report.recordings] == [()] * len(report.recordings)


def test_a_folder_a_table_and_files_that_do_not_exist_are_named(tmp_path: Path) -> None:
    for call, missing in (
        (lambda: read_capture(tmp_path / "nowhere"), "nowhere"),
        (lambda: read_capture(tmp_path), tmp_path / "impacts.csv"),
        (lambda: CaptureSettings.read(tmp_path / "nowhere.toml"), "nowhere.toml"),
    ):
        with raises(CaptureError, file=missing):
            call()
    fill(tmp_path)
    for name, near in (("other.wav", None), ("aa.wav", "a.wav"), ("takes/a.wav", None)):
        with raises(CaptureError, file=tmp_path / name, value=near):
            read_recording(tmp_path / name)


def test_mixed_rates_are_refused_with_their_counts(tmp_path: Path) -> None:
    folder = fill(tmp_path)
    fill(tmp_path / "other", rate=RATE + 1)
    (tmp_path / "other/c.wav").rename(folder / "c.wav")
    with raises(CaptureError, name="sample_rate", value=[RATE, RATE + 1]):
        read_capture(folder)
    assert not check(folder).readable


def test_a_compressed_file_is_measured_by_its_header(tmp_path: Path) -> None:
    channels, name = 8, tmp_path / "silence.wav"
    with soundfile.SoundFile(name, "w", RATE, channels, subtype="PCM_16", format="FLAC") as file:
        for _ in range(17):
            file.write(np.zeros((MAX_SAMPLES // channels // 16, channels), dtype=np.int16))
    assert name.stat().st_size < 1e6
    with raises(CaptureError, file=name, value=17 * MAX_SAMPLES // 16):
        read_recording(name)


def test_samples_without_a_header_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(bytes(4000))
    (tmp_path / "impacts.csv").write_text("file,x,y,z\na.raw,0,0,0\n")
    assert "cannot be read" in check(tmp_path).recordings[0].problems[0]
    with raises(CaptureError, file=tmp_path / "missing.wav"):
        read_recording(str(tmp_path / "missing.wav"))
