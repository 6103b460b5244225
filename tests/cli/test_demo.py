"""The demo goes all the way, and says of itself what was measured."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from avmsf.cli import demo, main
from avmsf.cli.demo import verdict, wall_words
from avmsf.evaluation.splits import Scores
from avmsf.field.store import load
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.ply import read_splats
from avmsf.pipeline.config import LiftConfig, PipelineConfig, SceneConfig, ViewsConfig
from avmsf.simulate.recipe import EXAMPLE
from factories.plate_field import QUICK

METHODS = {
    "field": "the model",
    "nearest recording": "the nearest recording",
    "mean waveform of 3 nearest": "the mean of the three nearest recordings",
}


def test_the_demo_goes_all_the_way(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lift = LiftConfig(encoder="descriptors", symmetry=False)
    small = SceneConfig(ViewsConfig(count=6), SplatConfig(steps=30, start_points=400), lift)
    monkeypatch.setattr(demo, "CONFIG", PipelineConfig("network", scene=small, fit=QUICK))
    folder = tmp_path / "demo"
    assert main(["demo", str(folder), "--json"]) == 0
    out, err = capsys.readouterr()
    assert all(f"{stage}: " in err for stage in ("check", "splat", "features", "modes", "fit", "page"))
    told = json.loads((folder / "demo.json").read_text())
    error = {method: each["relative_stft"] for method, each in told["scores"].items()}
    assert error["the held-out recordings' own gains, no noise"] < error["field"] < error["white noise"]
    best = min(METHODS, key=lambda name: error[name])
    assert f"has {METHODS[best]}." in err
    assert json.loads(out) == {"output": str(folder), **told}
    assert "| field |" in (folder / "scores.md").read_text()
    files = {each.relative_to(folder).as_posix() for each in folder.rglob("*") if each.is_file()}
    assert {name for name in files if not name.startswith(("capture/", ".demo/"))} == {
        *("demo.json", "mug.html", "mug.ply", "mug.safetensors", "scores.md"),
        *(f"pictures/{name}.png" for name in ("modes", "scores", "spectrograms")),
        *(
            f"sounds/impact-{row}-{kind}.wav"
            for row in (1, 2)
            for kind in ("1-recorded", "2-model", "3-mean-of-nearest")
        ),
    }
    assert len(read_splats(folder / "mug.ply")) > 100
    assert all(np.abs(soundfile.read(sound)[0]).max() <= 1 for sound in (folder / "sounds").iterdir())
    assert len(load(folder / "mug.safetensors").origin.trained_on) == 12
    assert list(tmp_path.iterdir()) == [folder]
    # Once more, from what is kept: the same field.
    (folder / "capture" / "notes.txt").touch()
    (folder / "demo.json").unlink()
    assert main(["demo", str(folder), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert {**again, "stages": None} == {**json.loads(out), "stages": None}
    assert (folder / "capture" / "notes.txt").is_file()


@pytest.mark.parametrize("best", METHODS)
def test_the_verdict_names_what_is_nearest_whatever_that_is(best: str) -> None:
    errors = torch.tensor([0.2, 0.3], dtype=torch.float64)
    scores = {name: Scores(("a", "b"), {"relative_stft": errors + (name != best)}) for name in METHODS}
    words = verdict(scores, 2)
    assert f"has {METHODS[best]}." in words
    assert f"{METHODS[best]} has 0.25" in words
    assert words.count("has 1.2") == 2


def test_the_thickness_found_is_printed_beside_the_true_one() -> None:
    words = wall_words({"thickness": {"median": 0.00223, "low": 0.00174, "high": 0.00286}})
    assert [float(number) for number in re.findall(r"([\d.]+) mm", words)] == [2.2, 2.9, 1000 * EXAMPLE.thickness]
    assert wall_words({"thickness": None}) == wall_words({}) == ""
