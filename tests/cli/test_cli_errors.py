"""What the user can get wrong at the command line: exit code 2 and one line that says what to do."""

import math
from pathlib import Path
from typing import Any

import pytest

from avmsf.cli import main
from avmsf.errors import AvmsfError
from factories.plate_capture import TINY, fill_plate
from factories.raising import raises
from factories.verbs import run_verb

Streams = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with captures, a field, and tables of contacts that cannot be used."""
    folder = tmp_path_factory.mktemp("place")
    fill_plate(folder / "plate")
    fill_plate(folder / "fast", rate=9000.0)
    words = ["fit", str(folder / "plate"), "--output", str(folder / "field.safetensors"), *TINY]
    assert main([*words, "--gain-model", "smooth", "--set", "fit.steps=1"]) == 0
    (folder / "not-ours.safetensors").write_bytes(b"RIFF and so on")
    (folder / "no-z.csv").write_text("file,x,y\na.wav,0,0\n")
    (folder / "far.csv").write_text("file,x,y,z\na.wav,0.1,0.05,0\n\nb.wav,50,60,0\n")
    (folder / "empty.csv").write_text("x,y,z\n")
    (folder / "words.csv").write_text("x,y,z\n0,0,0\n0.1,left,0\n")
    (folder / "short.csv").write_text("x,y,z\n0,0\n")
    (folder / "twice.csv").write_text("file,x,y,z\na.wav,0,0,0\na,0.1,0,0\n")
    (folder / "outside.csv").write_text("file,x,y,z\n../a.wav,0,0,0\n")
    (folder / "wrong.toml").write_text('unit = "miles"\n')
    return folder


LONG, TOO_LONG = 300 * "x", "File name too long"
AT = "--position 0.1 0.05 0"
TABLE = "render field.safetensors --output s --contact-table"
WRONG: dict[str, dict[str, Any]] = {
    "check plate --settings wrong.toml": {"file": "wrong.toml", "name": "unit", "value": "miles"},
    "modes nowhere": {"file": "nowhere"},
    "modes plate --settings nowhere.toml": {"file": "nowhere.toml"},
    "modes plate --modes 0": {"name": "modes", "value": 0},
    "fit nowhere -o f.safetensors": {"file": "nowhere"},
    "fit plate --output plate": {"file": "plate", "value": "folder"},
    "fit plate --output words.csv/f.safetensors": {"file": "words.csv", "value": "file"},
    "fit plate --output f.safetensors --train-count 8": {"value": 8},
    "fit plate --output f.safetensors --train-fraction 1.5": {"name": "--train-fraction", "value": 1.5},
    "fit plate --output f.safetensors --train-count 4 --start 8": {"name": "start", "value": 8},
    "fit plate --output f.safetensors --train-count 4 --train-fraction 0.5": {"name": "--train-count"},
    "fit plate --output f.safetensors --set validation=2": {"name": "validation", "value": 2.0},
    "fit plate --output f.safetensors --material glass --train-count 4": {"name": "--train-count", "value": "glass"},
    "fit plate --material glass --start 2": {"name": "--start", "value": "glass"},
    "fit plate --until gaussians --without-shape": {"name": "--without-shape", "value": "gaussians"},
    "fit plate --start 5": {"name": "--start"},
    "fit plate --output f.safetensors --material wodo": {"name": "--material", "value": "wodo"},
    "fit plate/surface.ply --output f.safetensors": {"file": "surface.ply", "name": "--material"},
    "fit plate --output f.wav": {"file": "f.wav", "name": "suffix", "value": ".wav"},
    "edit field.safetensors --pitch 2 --output f": {"file": "f", "name": "suffix", "value": ""},
    "fit plate --until gaussians --output f.obj": {"file": "f.obj", "name": "suffix", "value": ".obj"},
    "fit plate --until features --output f.ply": {"file": "f.ply", "name": "suffix", "value": ".ply"},
    "modes plate --plots m.png": {"file": "m.png", "name": "suffix", "value": ".png"},
    f"render field.safetensors {AT} --output s.mp3": {"file": "s.mp3", "name": "suffix", "value": ".mp3"},
    "export field.safetensors --to faust --output f.wav": {"file": "f.wav", "name": "suffix", "value": ".wav"},
    "fit field.safetensors -o f.safetensors": {"file": "field.safetensors", "value": "a sound field"},
    "fit plate/001.wav -o f.safetensors": {"file": "001.wav", "value": "a recording"},
    "locate field.safetensors field.safetensors": {"file": "field.safetensors", "value": "a sound field"},
    f"render plate/001.wav {AT} --output s": {"file": "001.wav", "value": "a recording"},
    "info plate/001.wav": {"file": "001.wav", "value": "a recording"},
    "info plate": {"file": "plate", "value": "a folder"},
    "render nowhere.safetensors --position 0 0 0 -o s": {"file": "nowhere.safetensors"},
    f"render not-ours.safetensors {AT} --output s": {"file": "not-ours.safetensors"},
    "render field.safetensors --output s": {"name": "--position", "value": 0},
    f"{TABLE} no-z.csv {AT}": {"name": "--position", "value": 1},
    "render field.safetensors --position 50 60 0 --output s": {
        "name": "--position",
        "row": 0,
        "value": [50.0, 60.0, 0.0],
    },
    f"render field.safetensors {AT} --position 50 60 0 --output s": {"name": "--position", "row": 1},
    f"{TABLE} far.csv": {"file": "far.csv", "row": 4, "name": "b.wav", "value": [50.0, 60.0, 0.0]},
    f"render field.safetensors {AT} --output s --direction nan 0 1": {"name": "directions", "row": 0},
    "render field.safetensors --position nan 0 0 --output s": {"name": "--position", "row": 0},
    f"render field.safetensors {AT} {AT} --direction 0 0 1 -o s": {"name": "--direction", "value": 1},
    f"render field.safetensors {AT} {AT} --output two.wav": {"file": "two.wav", "value": 2},
    f"render field.safetensors {AT} --output words.csv": {"file": "words.csv", "value": ".csv"},
    f"render field.safetensors {AT} --output s --seconds 0": {"name": "--seconds", "value": 0.0},
    f"render field.safetensors {AT} --output s --seconds nan": {"name": "--seconds"},
    f"render field.safetensors {AT} --output s --seconds 1e9": {"name": "--seconds", "value": 1e9},
    f"render field.safetensors {AT} --output s --contact-time 2": {"name": "--contact-time", "value": 2.0},
    f"render field.safetensors {AT} --output s --level-db nan": {"name": "finite"},
    f"render field.safetensors {AT} --output s --force -1": {"name": "--force", "value": -1.0},
    f"render field.safetensors {AT} --output s --force inf": {"name": "--force", "value": math.inf},
    f"{TABLE} nowhere.csv": {"file": "nowhere.csv"},
    f"{TABLE} no-z.csv": {"file": "no-z.csv", "row": 1, "name": "z"},
    f"{TABLE} empty.csv": {"file": "empty.csv", "name": None},
    f"{TABLE} words.csv": {"file": "words.csv", "row": 3, "name": "y", "value": "left"},
    f"{TABLE} short.csv": {"file": "short.csv", "row": 2, "name": "z", "value": 2},
    f"{TABLE} twice.csv": {"file": "twice.csv", "row": 3, "name": "file", "value": "a.wav"},
    f"{TABLE} outside.csv": {"file": "outside.csv", "row": 2, "name": "file", "value": "../a.wav"},
    f"render field.safetensors {AT} --output {LONG}/x.wav": {"file": f"{LONG}/x.wav", "value": TOO_LONG},
    f"render field.safetensors {AT} --output {LONG}": {"file": LONG, "value": TOO_LONG},
    f"edit field.safetensors --pitch 2 -o {LONG[:240]}.safetensors": {"value": TOO_LONG},
    f"export field.safetensors --to web -o {LONG}/x.html": {"file": f"{LONG}/x.html", "value": TOO_LONG},
    f"demo {LONG}": {"file": LONG, "value": TOO_LONG},
    f"info {LONG}": {"file": LONG},
    "info nowhere.safetensors": {"file": "nowhere.safetensors"},
    "info field.safetensors --capture fast": {"name": "sample_rate"},
    "demo plate": {"file": "plate"},
    "demo words.csv": {"file": "words.csv", "name": "suffix", "value": ".csv"},
}


@pytest.mark.parametrize("words", WRONG)
def test_one_line_says_what_is_wrong(words: str, place: Path, capsys: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    before = {path.name for path in place.iterdir()}
    verb, *arguments = words.split()
    with raises(AvmsfError, **WRONG[words]) as caught:
        run_verb(verb, *arguments)
    capsys.readouterr()
    assert main(words.split()) == 2
    err = capsys.readouterr().err
    # Progress may come before.
    assert err.splitlines()[-1] == f"avmsf {verb}: {' '.join(str(caught.value).split())}"
    assert "Traceback" not in err
    assert {path.name for path in place.iterdir()} == before
