"""What `check` measures, that it goes on past every broken thing, and what it remarks on."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
import trimesh

from avmsf.capture import CaptureSettings, check, read_capture
from avmsf.capture.checks import expect_held
from avmsf.errors import CaptureError
from avmsf.mesh.surface import Surface
from factories.capture_folder import RATE, ROWS, fill, ring
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


def test_it_goes_on_past_everything_that_is_broken(tmp_path: Path) -> None:
    rows = (*ROWS, "gone.wav,0,0,0.1", "d.wav,0,0,0.1", "e.wav,0,0,0.2", "f.wav,0,left,0.1", "g.wav,0,0,0.15")
    clipped = np.clip(10 * ring(), -1, 1)
    double = ring(1.0) + np.concatenate([np.zeros(3200), ring(0.6, seed=9)])
    folder = fill(
        tmp_path / ".work" / "cup",
        rows=rows,
        replace={"b.wav": clipped, "c.wav": double, "d.wav": np.zeros(4000), "f.wav": ring(), "stray.wav": ring()},
    )
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
    assert "stray.wav" in unlisted
    assert "002" not in unlisted
    # What the command line prints as JSON.
    assert json.loads(json.dumps(asdict(report), allow_nan=False))["recordings"][1]["clipped"] > 3


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


def test_rows_in_the_order_of_text_and_not_of_numbers_are_remarked_on(tmp_path: Path) -> None:
    names = [f"{number}.wav" for number in range(1, 11)]
    sounds = {name: ring(1.0, before=0.25, seed=row) for row, name in enumerate(names)}
    for way, remarked in ((sorted(names), True), (names, False), (names[::-1], False)):
        report = check(fill(tmp_path / f"{way[1]}{way[2]}", sounds={name: sounds[name] for name in way}))
        assert any("order of text" in each for each in report.remarks) is remarked


def test_a_point_far_from_the_object_does_not_hold_it() -> None:
    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    surface = Surface(torch.from_numpy(cube.vertices), torch.from_numpy(cube.faces))
    expect_held([(0.0, 0.0, 0.05), (0.05, 0.0, 0.06)], surface)
    with raises(CaptureError, name="held", value=pytest.approx(0.95)):
        expect_held([(0.0, 0.0, 0.05), (0.0, 0.0, 1.0)], surface)
