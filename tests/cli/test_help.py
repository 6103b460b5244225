"""Help and errors: one screen, one line."""

import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from avmsf.cli import VERBS, main, options_of
from avmsf.cli.edit import Options as EditOptions
from avmsf.cli.evaluate import Options as EvaluateOptions
from avmsf.cli.fit import Options as FitOptions
from avmsf.cli.simulate import Options as SimulateOptions
from avmsf.errors import AvmsfError
from avmsf.field.store import save
from avmsf.simulate.recipe import named_recipe
from factories.made_fields import positional, sounding
from factories.plate_capture import fill_plate
from factories.raising import raises
from factories.verbs import Streams, run_verb

MOST_LINES = 50
"""Of a help at 80 columns."""


@pytest.mark.parametrize("verb", VERBS)
def test_a_help_fits_on_one_screen(verb: str, capsys: Streams, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit, match="0"):
        main([verb, "--help"])
    out = capsys.readouterr().out
    # tyro folds the texts of options, not the paragraphs above them.
    assert sum(-(-len(line) // 80) for line in out.splitlines()) <= MOST_LINES
    options = re.findall(r"^│ -[-\w]", out, re.MULTILINE)
    assert len(options) <= 25
    assert VERBS[verb] in " ".join(out.split())
    # An argument before it takes nothing out of it.
    with pytest.raises(SystemExit, match="0"):
        main([verb, "edit", "--help"])
    assert capsys.readouterr().out.endswith(out)


@pytest.mark.parametrize(
    ("options", "needed", "words"),
    [
        (FitOptions, ["mug"], "--preset paper --set time_zero=null --set modes=5 --seed 3 --set fft_sizes=512,256"),
        (SimulateOptions, [], "--set noise_db=None --set mesh=a.obj -o x mug-ceramic --impacts 5 --set hammer.mass=1"),
        (EvaluateOptions, ["farthest", "data"], "--set geometry=gaussians --set body.wall=0"),
        (EditOptions, ["field", "-o", "new"], "--set prompt.generated=x.wav --set model_seconds=Infinity"),
    ],
)
def test_settings_are_printed_as_a_file_that_gives_them_back(options, needed, words, tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        options.parse([*words.split(), "--print-config"])
    file = tmp_path / "settings.toml"
    # As editors on Windows save it.
    file.write_text(capsys.readouterr().out, encoding="utf-8-sig")
    assert options.parse([*needed, *words.split()]).all_settings != options.usual
    read = options.parse([*needed, "--config", str(file)])
    assert read.all_settings == options.parse([*needed, *words.split()]).all_settings


def test_settings_of_one_object_change_those_of_a_set() -> None:
    recipe = named_recipe("mug-ceramic")
    assert SimulateOptions.parse(["sim-20", "--impacts", "5"]).applied(recipe) == replace(recipe, impacts=5)


REFUSED: dict[str, dict[str, Any]] = {
    # The objects of a set stay what they are.
    "simulate sim-20 -o x --set kind=bowl": {"name": "kind"},
    "simulate sim-20 -o x --kind bowl": {"name": "kind"},
    "simulate sim-20 -o x --seed 0": {"name": "seed"},
    # A setting is given once, by one name, with a value of its type.
    "fit mug --gain-model smooth --set gain_model=visual": {"name": "gain_model"},
    "fit mug --seed 1 --set fit.seed=2": {"name": "fit.seed"},
    "fit mug --set steps=3": {"value": "steps"},
    "fit mug --set splat.stepz=4": {"value": "splat.stepz"},
    "fit mug --set splat.steps=x": {"value": "x"},
    "fit mug --set splat": {"value": "splat"},
}


@pytest.mark.parametrize("words", REFUSED)
def test_settings_that_cannot_be_meant_are_refused(words: str) -> None:
    verb, *arguments = words.split()
    with raises(AvmsfError, **REFUSED[words]):
        options = options_of(verb, arguments)
        _ = options.all_settings
        options.check_inputs()


def test_values_are_numbers_words_truth_values_and_lists_of_these() -> None:
    words = ["fft_sizes=512,256", "background=1,0,0.5", "lift.symmetry=false", "body.wall=0", "views.source=mesh"]
    made = FitOptions.parse(["mug", *(each for word in words for each in ("--set", word))]).all_settings
    assert (made.fit.fft_sizes, made.scene.splat.background) == ((512, 256), (1.0, 0.0, 0.5))
    assert (made.scene.lift.symmetry, made.body.wall, made.scene.views.source) == (False, 0.0, "mesh")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with captures, a field, and tables of contacts that cannot be used."""
    folder = tmp_path_factory.mktemp("place")
    fill_plate(folder / "plate")
    fill_plate(folder / "fast", rate=9000.0)
    save(sounding(positional()), folder / "field.safetensors")
    (folder / "empty").mkdir()
    (folder / "cells").mkdir()
    (folder / "cells" / "impacts.csv").write_text("file,x,y,z\n001.wav,0,0,0\n002.wav,left,0,0\n")
    (folder / "not-ours.safetensors").write_bytes(b"RIFF and so on")
    (folder / "no-z.csv").write_text("file,x,y\na.wav,0,0\n")
    (folder / "far.csv").write_text("file,x,y,z\na.wav,0.1,0.05,0\n\nb.wav,50,60,0\n")
    (folder / "words.csv").touch()
    (folder / "twice.csv").write_text("file,x,y,z\na.wav,0,0,0\na,0.1,0,0\n")
    (folder / "outside.csv").write_text("file,x,y,z\n../a.wav,0,0,0\n")
    (folder / "miles").mkdir()
    (folder / "miles" / "capture.toml").write_text('unit = "miles"\n')
    return folder


AT = "--position 0.1 0.05 0"
TABLE = "render field.safetensors --output s --contact-table"
EARLY: dict[str, dict[str, Any]] = {
    # What is wrong with the capture is said before what is wrong with the name of the output.
    "fit miles -o f": {"file": "miles/capture.toml", "name": "unit", "value": "miles"},
    "modes plate --modes 0": {"name": "modes", "value": 0},
    "fit plate --output plate": {"file": "plate", "value": "folder"},
    "fit plate --output words.csv/f.safetensors": {"file": "words.csv", "value": "file"},
    "fit plate --output f.safetensors --train-count 4 --train-fraction 0.5": {"name": "--train-count"},
    "fit plate --output f.safetensors --train-fraction 75": {"name": "--train-fraction", "value": 75.0},
    "fit plate --output f.safetensors --set validation=2": {"name": "validation", "value": 2.0},
    "fit plate --output f.safetensors --material glass --train-count 4": {"name": "--train-count", "value": "glass"},
    "fit plate --until gaussians --without-shape": {"name": "--without-shape", "value": "gaussians"},
    "fit plate --output f.safetensors --material wodo": {"name": "--material", "value": "wodo"},
    "fit plate/surface.ply --output f.safetensors": {"file": "surface.ply", "name": "--material"},
    "fit plate --until gaussians --output f.obj": {"file": "f.obj", "name": "suffix", "value": ".obj"},
    f"render field.safetensors {AT} --output s.mp3": {"file": "s.mp3", "name": "suffix", "value": ".mp3"},
    "fit field.safetensors -o f.safetensors": {"file": "field.safetensors", "value": "a sound field"},
    f"render plate/001.wav {AT} --output s": {"file": "001.wav", "value": "a recording"},
    "info plate": {"file": "plate", "value": "a folder"},
    f"render not-ours.safetensors {AT} --output s": {"file": "not-ours.safetensors"},
    "render field.safetensors --output s": {"name": "--position", "value": 0},
    f"{TABLE} far.csv {AT}": {"name": "--position", "value": 1},
    f"render field.safetensors {AT} {AT} --direction 0 0 1 -o s": {"name": "--direction", "value": 1},
    f"render field.safetensors {AT} --output words.csv": {"file": "words.csv", "value": ".csv"},
    f"render field.safetensors {AT} --output s --contact-time 2": {"name": "--contact-time", "value": 2.0},
    f"render field.safetensors {AT} --output s --force -1": {"name": "--force", "value": -1.0},
    f"render field.safetensors {AT} --output s --force inf": {"name": "--force", "value": math.inf},
    f"render field.safetensors {AT} --output s --level-db nan": {"name": "--level-db"},
    f"render field.safetensors {AT} --output s --level-db 1e4": {"name": "--level-db", "value": 1e4},
    "demo plate": {"file": "plate"},
    "fit cells -o f.safetensors": {"file": "impacts.csv", "row": 3, "name": "x", "value": "left"},
    "fit empty -o f.safetensors": {"file": "empty/impacts.csv"},
    "fit empty --material glass": {"file": "empty"},
    "fit plate -o f.safetensors --set modes=0": {"name": "modes", "value": 0},
    f"{TABLE} no-z.csv": {"file": "no-z.csv", "row": 1, "name": "z"},
    "locate field.safetensors": {"name": "recordings", "value": 0},
    "suggest field.safetensors --unseen --candidates plate": {"name": "--unseen"},
    "export field.safetensors --to wavs -o plate --overwrite": {"file": "plate", "name": "--overwrite"},
    "edit field.safetensors -o new.safetensors": {"name": "options"},
    "evaluate nope plate": {"name": "protocol", "value": "nope"},
    "evaluate farthest empty": {"file": "empty"},
    "simulate": {"name": "output"},
    "studio": {"name": "target"},
}
"""What is refused before torch, which takes seconds, is loaded."""
LATE: dict[str, dict[str, Any]] = {
    "fit plate -o f.safetensors --device tpu": {"name": "device", "value": "tpu"},
    "render field.safetensors --position 50 60 0 -o s": {"name": "--position", "row": 0, "value": [50.0, 60.0, 0.0]},
    f"render field.safetensors {AT} --position 50 60 0 --output s": {"name": "--position", "row": 1},
    f"{TABLE} far.csv": {"file": "far.csv", "row": 4, "name": "b.wav", "value": [50.0, 60.0, 0.0]},
    f"render field.safetensors {AT} --output s --direction nan 0 1": {"name": "directions", "row": 0},
    "render field.safetensors --position nan 0 0 --output s": {"name": "--position", "row": 0},
    f"render field.safetensors {AT} {AT} --output two.wav": {"file": "two.wav", "value": 2},
    f"render field.safetensors {AT} --output s --seconds 0": {"name": "--seconds", "value": 0.0},
    f"render field.safetensors {AT} -o s --normalize peak --level-db 6 --coding int16": {
        "file": "s/001.wav",
        "name": "peak",
    },
    f"render field.safetensors {AT} --output plate": {"file": "plate/001.wav", "name": "--overwrite"},
    f"render field.safetensors {AT} --output s --seconds nan": {"name": "--seconds"},
    f"render field.safetensors {AT} --output s --seconds 1e9": {"name": "--seconds", "value": 1e9},
    f"render field.safetensors {AT} --output s --force 1e300": {"name": "samples"},
    f"{TABLE} twice.csv": {"file": "twice.csv", "row": 3, "name": "file", "value": "a.wav"},
    f"{TABLE} outside.csv": {"file": "outside.csv", "row": 2, "name": "file", "value": "../a.wav"},
    "info field.safetensors --capture fast": {"name": "sample_rate"},
}
WRONG = EARLY | LATE
CODE = """
import contextlib, io, json, sys
from avmsf.cli import main
from avmsf.cli.paths import Existing, InputError
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(words.split())
    assert (code, len(said.getvalue().splitlines()), "torch" in sys.modules) == (2, 1, False), (words, said.getvalue())
"""


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


def test_no_early_refusal_loads_torch(place: Path) -> None:
    command = [sys.executable, "-c", CODE, json.dumps([*EARLY])]
    ran = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
