"""The demo, suggestions, reports and interruptions."""

import csv
import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import soundfile

from avmsf._utils.progress import ProgressDisplay
from avmsf.cli import demo, main
from avmsf.field.store import load, save
from avmsf.gaussians.ply import read_splats
from avmsf.mesh import Surface
from avmsf.mesh.queries import ClosestPoints
from factories.believing_field import bar_contacts, drawn_gains, elastic_field, sound_field
from factories.plate_capture import TINY, fill_plate
from factories.verbs import Streams, results_of


@pytest.mark.slow
def test_the_demo_goes_all_the_way_and_errs_by_half_of_the_nearest_recording(
    tmp_path: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch
) -> None:
    check, fit, *_ = demo.COMMANDS
    folder = tmp_path / "a demo"
    # A process of its own is without checks of types at run time, with which the fit takes three times as long.
    out = subprocess.run(
        [sys.executable, "-m", "avmsf", "demo", str(folder)], stdout=subprocess.PIPE, text=True, check=True
    ).stdout
    printed = [shlex.split(line[2:]) for line in out.splitlines() if line.startswith("$ ")]
    assert printed == [["avmsf", *shlex.split(each.format(shlex.quote(str(folder))))] for each in demo.COMMANDS]
    made, field = (folder / "mug.safetensors").read_bytes(), load(folder / "mug.safetensors")
    assert len(field.origin.trained_on) == 12
    assert len(read_splats(folder / "mug.ply")) > 100
    assert {"mug.html", "mug-surface.ply", "capture"} < {each.name for each in folder.iterdir()}
    assert {"modes.png", "spectrograms.png"} < {each.name for each in (folder / "pictures").iterdir()}
    assert len([soundfile.info(each) for each in (folder / "sounds").glob("*.wav")]) == 16
    assert main([*shlex.split(fit.format(shlex.quote(str(folder)))), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    errors = {method: each["relative_stft"] for method, each in found["scores"].items()}
    assert errors["field"] < 0.5 * errors["nearest recording"]
    wall = found["report"]["thickness"]
    assert wall["low"] < wall["median"] < wall["high"]
    assert wall["median"] == pytest.approx(demo.EXAMPLE.thickness, rel=0.4)
    assert 0.6 < found["body"]["wall_thickness"] / (demo.EXAMPLE.thickness or 0.0) < 1.2
    assert field.origin.report["thickness"] == wall
    # Gaussians lie below the surface; the field's points are on it.
    surface = Surface.read(folder / "mug-surface.ply")
    nearest = ClosestPoints(surface.vertices.double().numpy()[surface.faces.numpy()])
    assert nearest(field.gain_field.points.double().numpy()).distances.max() < 1e-6
    (folder / "capture" / "notes.txt").touch()
    assert main(["demo", str(folder), "--quiet"]) == 0
    assert (folder / "mug.safetensors").read_bytes() == made
    assert (folder / "capture" / "notes.txt").is_file()
    (folder / "capture" / "003.wav").write_bytes(b"no sound")
    monkeypatch.setattr(demo, "COMMANDS", [check, fit])
    assert main(["demo", str(folder)]) == 2
    assert "$ avmsf fit" not in capsys.readouterr().out


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    contacts = bar_contacts(6)
    path = tmp_path_factory.mktemp("fields") / "bar.safetensors"
    save(sound_field(elastic_field(contacts, drawn_gains(contacts, seed=1))), path)
    return path


def test_the_list_to_walk_by_is_what_is_printed(field: Path, tmp_path: Path, capsys: Streams) -> None:
    printed, _ = results_of(capsys, "suggest", field, "--count", "3", "--plots", tmp_path / "next")
    with open(tmp_path / "next" / "suggested.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["order"] for row in rows] == ["1", "2", "3"]
    for row, known in zip(rows, printed["suggestions"], strict=True):
        for name in ("x", "y", "z", "nx", "ny", "nz", "error_after"):
            assert float(row[name]) == pytest.approx(known[name], rel=1e-5, abs=1e-9)
    errors = [printed["error_before"], *(each["error_after"] for each in printed["suggestions"])]
    assert errors == sorted(errors, reverse=True)
    assert (tmp_path / "next" / "suggested.png").read_bytes().startswith(b"\x89PNG")


NETWORK = ("--gain-model", "network", "--without-shape", *TINY)


def test_the_same_command_goes_on(tmp_path, capsys, monkeypatch):
    folder, cache, field = fill_plate(tmp_path / "plate"), tmp_path / "plate" / ".avmsf", tmp_path / "field.safetensors"
    shown: list[int] = []

    def show(self: ProgressDisplay, stage: str, done: int, total: int, message: str) -> None:
        shown.append(done)
        if len(shown) == 14:
            raise KeyboardInterrupt

    monkeypatch.setattr(ProgressDisplay, "step", show)
    words = ["fit", str(folder), "--output", str(field), *NETWORK]
    assert main(words) == 130
    assert (cache / "field.safetensors.checkpoint").exists()
    assert (cache / "modes.safetensors").exists()
    assert not field.exists()
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1] == "avmsf fit: interrupted; repeat the command to continue"
    del shown[:]
    assert main(words) == 0
    # Of the six steps end to end, those after the second.
    assert shown == [3, 4, 5, 6]
    assert not (cache / "field.safetensors.checkpoint").exists()
    assert field.exists()
