"""What `check` and `modes` report of the alignment, and that both report the same."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from avmsf.cli import main

RATE, COUNT = 8000, 8


def fill(folder: Path, *, own_phases: int | None = None) -> Path:
    """Write recordings of five modes with the impact after .1 s and some samples; one may have phases of its own."""
    folder.mkdir()
    generator = np.random.default_rng(1)
    starts = 800 + np.array([0, 2, -1, 1, -2, 0, 1, -1])
    phases, rows = np.array([0.2, 1.1, -0.6, 2.0, 0.9]), ["file,x,y,z"]
    for number in range(COUNT):
        time = (np.arange(6000) - starts[number]) / RATE
        gains = generator.normal(size=5)
        used = phases + (generator.uniform(0.6, 1.4, 5) * [1, -1, 1, -1, 1] if number == own_phases else 0.0)
        angles = 2 * np.pi * np.array([410.0, 733.0, 1190.0, 1805.0, 2620.0]) * time[:, None] + used
        sound = 0.05 * np.where(time >= 0, (np.exp(-15 * np.maximum(time, 0)[:, None]) * np.sin(angles)) @ gains, 0)
        soundfile.write(folder / f"{number}.wav", sound + 1e-4 * generator.normal(size=6000), RATE, subtype="FLOAT")
        rows.append(f"{number}.wav,{0.1 * number},0,0")
    (folder / "impacts.csv").write_text("\n".join(rows) + "\n")
    return folder


def alignment(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)["alignment"]


def test_check_and_modes_report_one_alignment(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = fill(tmp_path / "five")
    found = alignment(capsys, "check", str(folder))
    assert found == alignment(capsys, "modes", str(folder))
    assert found["coherence_after"] > 0.99 > found["coherence_before"]
    assert found["not_aligned"] == []


def test_a_recording_that_cannot_be_aligned_is_counted_as_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = fill(tmp_path / "five", own_phases=3)
    assert alignment(capsys, "check", str(folder))["not_aligned"] == ["3.wav"]
    assert main(["check", str(folder)]) == 0
    assert "no problem found" not in capsys.readouterr().out


def test_a_fade_out_of_all_recordings_is_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = fill(tmp_path / "five")
    for path in folder.glob("*.wav"):
        sound, rate = soundfile.read(path)
        soundfile.write(path, sound * np.minimum(1.0, np.linspace(2.0, 0.0, len(sound))), rate, subtype="FLOAT")
    assert main(["check", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "fade-out" in printed
    assert "no problem found" not in printed
