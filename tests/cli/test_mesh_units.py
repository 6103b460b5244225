"""A mesh in another unit than the contacts: every verb that reads both refuses it at once, with the unit that fits."""

import json
from pathlib import Path

import pytest

from avmsf.capture.settings import METRES
from avmsf.cli import main
from factories.plate_capture import fill_plate
from factories.small_scene import write_surface_file

Streams = pytest.CaptureFixture[str]
COMMANDS = (
    "check FOLDER",
    "modes FOLDER",
    "fit FOLDER -o OUT.safetensors",
    *(f"fit FOLDER --until {stage}" for stage in ("gaussians", "features", "surface")),
)


def capture_in(folder: Path, unit: str) -> Path:
    """Fill a folder with contacts in meters and a mesh in a unit that its settings do not name."""
    fill_plate(folder, surface=False)
    write_surface_file(folder)
    lines = [line.split() for line in (folder / "surface.obj").read_text().splitlines()]
    for line in lines:
        if line[0] == "v":
            line[1:] = [f"{float(value) / METRES[unit]:.9g}" for value in line[1:]]
    (folder / "surface.obj").write_text("\n".join([*map(" ".join, lines), ""]))
    return folder


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_names_the_unit_and_writes_nothing(command: str, tmp_path: Path, capsys: Streams) -> None:
    folder = capture_in(tmp_path / "plate", "mm")
    before = sorted(folder.rglob("*"))
    words = command.replace("FOLDER", str(folder)).replace("OUT", str(tmp_path / "out"))
    assert main(words.split()) == 2
    said = capsys.readouterr()
    assert 'surface_unit = "mm"' in said.out + said.err
    assert sorted(folder.rglob("*")) == before
    assert [each.name for each in tmp_path.iterdir()] == ["plate"]


@pytest.mark.parametrize("unit", ["mm", "cm", "in"])
def test_the_unit_that_fits_is_named_and_mends_the_capture(unit: str, tmp_path: Path, capsys: Streams) -> None:
    folder = capture_in(tmp_path / "plate", unit)
    assert main(["check", str(folder), "--json"]) == 2
    report = json.loads(capsys.readouterr().out)
    assert not report["readable"]
    line = f'surface_unit = "{unit}"'
    assert any(line in problem for problem in report["problems"])
    with open(folder / "capture.toml", "a") as file:
        file.write(f"{line}\n")
    assert main(["check", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["readable"]
