"""Mistakes that need no computation are refused before torch, which takes seconds to load."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from avmsf.cli.paths import Existing, InputError
from avmsf.pipeline.config import CACHE, CACHED_FIELD
from factories.raising import raises

STORED = Path(__file__).parents[1] / "field" / "data" / "format-8" / "mixture.safetensors"
REFUSED = (
    "fit cells -o f.safetensors",
    "fit empty -o f.safetensors",
    "fit good -o f.safetensors --device tpu",
    "fit good -o f.safetensors --train-fraction 2",
    "fit good -o f.safetensors --train-fraction 0.5 --train-count 4",
    "fit good -o f.safetensors --train-count 2",
    "fit good -o f.safetensors --modes 0",
    "fit good -o f.safetensors --material cheese",
    "fit one -o f.safetensors",
    "modes one",
    "check empty",
    "modes empty",
    "modes good --modes 0",
    "fit empty --until gaussians",
    "fit empty --until features",
    "fit empty --until surface",
    "fit good --until surface -o s.stl",
    "fit good --until surface --train-count 4",
    "fit empty",
    "fit empty --material glass",
    "info wrong.safetensors",
    "info newer.safetensors",
    "locate wrong.safetensors good/001.wav",
    "locate field.safetensors",
    "suggest wrong.safetensors",
    "suggest field.safetensors --unseen --candidates good",
    "export wrong.safetensors --to web -o page",
    "render wrong.safetensors --position 0 0 0 -o s",
    "render field.safetensors -o s",
    "render field.safetensors --position 0 0 0 -o s --force 0",
    "edit field.safetensors -o new.safetensors",
    "edit field.safetensors -o field.safetensors --pitch 2",
    "evaluate nope good",
    "evaluate farthest good --methods nope",
    "evaluate farthest empty",
    "simulate",
    "studio",
    "reconstruct good",
    "fit good -o f.wav",
    "edit field.safetensors -o new.wav --pitch 2",
    "render field.safetensors --position 0 0 0 -o s.mp3",
    "fit good --until features -o f.ply",
    "modes good --plots modes.png",
    "export field.safetensors --to wavs -o s.wav",
    "export field.safetensors --to wavs -o good --overwrite",
    "export field.safetensors --to faust -o theirs.dsp",
    "locate field.safetensors field.safetensors",
    "render good/001.wav --position 0 0 0 -o s",
    "fit field.safetensors -o f.safetensors",
    "info good/001.wav",
)
CODE = """
import contextlib, io, json, sys
from avmsf.cli import main
found = {}
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = main(words.split())
    found[words] = [code, len(said.getvalue().splitlines()), "torch" in sys.modules]
    if "torch" in sys.modules:
        break
print(json.dumps(found))
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "empty").mkdir()
    for name, cell in (("good", "0.1"), ("one", "0.1"), ("cells", "left")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "impacts.csv").write_text(f"file,x,y,z\n001.wav,0,0,0\n002.wav,{cell},0,0\n")
    for each in ("good/001.wav", "good/002.wav", "one/001.wav", "one/02.wav"):
        (tmp_path / each).touch()
    (tmp_path / "theirs.dsp").touch()
    (tmp_path / "wrong.safetensors").write_bytes(b"RIFF and so on")
    field = STORED.read_bytes()
    (tmp_path / "field.safetensors").write_bytes(field)
    (tmp_path / "newer.safetensors").write_bytes(field.replace(b'\\"format\\": 8', b'\\"format\\": 9', 1))
    return tmp_path


def test_no_refusal_loads_torch(place: Path) -> None:
    command = [sys.executable, "-c", CODE, json.dumps(REFUSED)]
    ran = subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=120, check=True, env=os.environ)
    found = json.loads(ran.stdout)
    assert found == {words: [2, 1, False] for words in REFUSED}


def test_the_field_that_a_folder_keeps_is_named(tmp_path: Path) -> None:
    folder, advice = tmp_path / "bowl", []
    kept = folder / CACHE / CACHED_FIELD
    for _ in range(2):
        (tmp_path / "bowl" / CACHE).mkdir(parents=True, exist_ok=True)
        with raises(InputError, file=folder, value="a folder") as caught:
            Existing("a field", ("a sound field",)).check(folder)
        advice.append(str(caught.value))
        kept.touch()
    assert [str(kept) in each for each in advice] == [False, True]
