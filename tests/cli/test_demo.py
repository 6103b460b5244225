"""The demo runs the commands that it prints, to the end, and again from what they have made."""

import json
import shlex
from pathlib import Path

import pytest
import soundfile

from avmsf.cli import demo, main
from avmsf.field.store import load
from avmsf.gaussians.ply import read_splats

SMALL = "--set views.count=6 --set splat.steps=30 --set start_points=400 --set fit.steps=2 --gain-model thin-plate"


@pytest.mark.slow
def test_the_demo_errs_by_half_of_the_nearest_recording_and_finds_the_wall(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", str(tmp_path), "--quiet"]) == 0
    capsys.readouterr()
    assert main([*shlex.split(demo.COMMANDS[1].format(tmp_path)), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    errors = {method: each["relative_stft"] for method, each in found["scores"].items()}
    assert errors["field"] < 0.5 * errors["nearest recording"]
    assert 0.6 < found["body"]["wall_thickness"] / (demo.EXAMPLE.thickness or 0.0) < 1.2


@pytest.mark.slow
def test_the_demo_goes_all_the_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    check, fit, *others = [each.replace("--set splat.steps=500", SMALL) for each in demo.COMMANDS]
    monkeypatch.setattr(demo, "COMMANDS", [check, fit, *others])
    folder = tmp_path / "a demo"
    assert main(["demo", str(folder)]) == 0
    out = capsys.readouterr().out
    printed = [shlex.split(line[2:]) for line in out.splitlines() if line.startswith("$ ")]
    assert printed == [["avmsf", *shlex.split(each.format(shlex.quote(str(folder))))] for each in demo.COMMANDS]
    assert (folder / "capture" / "001.wav").is_file()
    assert len(load(folder / "mug.safetensors").origin.trained_on) == 12
    assert len(read_splats(folder / "mug.ply")) > 100
    assert {"mug.html", "mug-surface.ply", "capture"} < {each.name for each in folder.iterdir()}
    assert {"modes.png", "spectrograms.png"} < {each.name for each in (folder / "pictures").iterdir()}
    assert len([soundfile.info(each) for each in (folder / "sounds").glob("*.wav")]) == 16
    made = (folder / "mug.safetensors").read_bytes()
    (folder / "capture" / "notes.txt").touch()
    monkeypatch.setattr(demo, "COMMANDS", [fit, check])
    assert main(["demo", str(folder), "--quiet"]) == 0
    assert (folder / "mug.safetensors").read_bytes() == made
    assert (folder / "capture" / "notes.txt").is_file()
    (folder / "capture" / "003.wav").write_bytes(b"no sound")
    monkeypatch.setattr(demo, "COMMANDS", [check, fit])
    assert main(["demo", str(folder)]) == 2
    assert "$ avmsf fit" not in capsys.readouterr().out
