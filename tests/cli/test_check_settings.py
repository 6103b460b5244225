"""`avmsf check` proposes settings, writes them, and never overwrites a user's."""

import json
from pathlib import Path

import numpy as np
import pytest

from avmsf.capture import CaptureSettings
from avmsf.cli import main
from factories.capture_folder import RATE, fill, ring


@pytest.fixture
def rumbling(tmp_path: Path) -> Path:
    rumble = 0.03 * np.sin(2 * np.pi * 6 * np.arange(RATE) / RATE)
    return fill(
        tmp_path / "cup",
        replace={f"{name}.wav": ring(1.0, before=0.4, seed=seed) + rumble for seed, name in enumerate("abc")},
    )


def test_settings_are_written_once_and_hold_from_then_on(rumbling: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(rumbling), "--json"]) == 0
    before = json.loads(capsys.readouterr().out)
    assert [(each["key"], each["value"]) for each in before["proposals"]] == [("highpass", 20.0)]
    assert not (rumbling / "capture.toml").exists()
    assert main(["check", str(rumbling), "--write-settings", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["proposals"] == before["proposals"]
    assert CaptureSettings.read(rumbling / "capture.toml") == CaptureSettings(highpass=20.0)
    written = (rumbling / "capture.toml").read_text()
    # With them nothing more is proposed, so that nothing is written.
    assert main(["check", str(rumbling), "--write-settings"]) == 0
    assert (rumbling / "capture.toml").read_text() == written


def test_a_user_s_settings_are_not_overwritten(rumbling: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (rumbling / "capture.toml").write_text("seconds = 0.5\n")
    assert main(["check", str(rumbling), "--write-settings"]) == 2
    assert "highpass = 20.0" in capsys.readouterr().out
    assert (rumbling / "capture.toml").read_text() == "seconds = 0.5\n"


def test_other_settings_are_not_mixed_with_written_ones_nor_with_a_dataset(rumbling: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text("seconds = 0.5\n")
    assert main(["check", str(tmp_path)]) == 0
    assert main(["check", str(tmp_path), "--settings", str(other)]) == 2
    assert main(["check", str(tmp_path), "--write-settings"]) == 2
    assert main(["check", str(rumbling), "--settings", str(other), "--write-settings"]) == 2
    assert not (rumbling / "capture.toml").exists()


def test_recordings_that_start_with_the_impact_are_said_to_be_uncut(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    time = np.arange(4000) / RATE
    sounds = {f"{name}.wav": np.exp(-15 * time) * np.cos(2 * np.pi * 700 * time) / (2 + ord(name)) for name in "abc"}
    assert main(["check", str(fill(tmp_path, replace=sounds)), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["remarks"]) == 1
    assert {row["onset_seconds"] for row in report["recordings"]} == {0.0}
