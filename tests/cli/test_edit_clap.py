"""`avmsf edit --prompt --clap`: scores over the steps, with a tiny CLAP network of random weights."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from test_cli_edit import PLACES, RATE, Echo, ceramic, interrupt_at

from avmsf.cli import main
from avmsf.editing.modal_edit import EDITS, adjust_modes
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import AvmsfError
from avmsf.evaluation.clap import Clap
from avmsf.field.store import load, save
from factories.made_clap import save_clap
from factories.raising import raises
from factories.settings import sets
from factories.verbs import run_verb

PROMPT = "a bell"
QUICK = ("--prompt", PROMPT, "--model", "here", *sets("guide.steps=5 guide.contacts_per_step=2 guide.preview_every=2"))


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a command without its output: a field, a model that always answers the same sound, a tiny network."""
    pytest.importorskip("transformers", reason="needs pip install 'avmsf[eval]'")
    save_clap(tmp_path / "clap")
    save(ceramic(), tmp_path / "plate.safetensors")
    model = Echo(adjust_modes(ceramic(), pitch=1.02).render(PLACES[:1])[0])
    monkeypatch.setattr(StableAudio, "load", lambda *_, **__: model)
    return [str(tmp_path / "plate.safetensors"), *QUICK, "--set", f"prompt.clap={tmp_path / 'clap'}"]


def test_the_curve_is_stored_drawn_and_shown(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, Figure] = {}
    monkeypatch.setattr("avmsf.cli.edit_report.save_picture", lambda figure, path: drawn.update({path.name: figure}))
    output, folder = tmp_path / "new.safetensors", tmp_path / "look"
    assert run_verb("edit", *words, "--output", str(output), "--plots", str(folder)) == 0
    new, clap = load(output), Clap.load(tmp_path / "clap")
    curve = new.origin.report[EDITS][-1]["clap"]
    assert curve["steps"] == [0, 2, 4, 5]
    # The first score is of the field as it was, the last one of the edited field, at one of its points.
    for field, score in ((ceramic(), curve["scores"][0]), (new, curve["scores"][-1])):
        points = ceramic().gain_field.points
        alone = clap.score(field.render(points), [PROMPT], sample_rate=RATE).numpy()
        assert np.abs(alone - score).min() < 1e-6
    (axes,) = drawn["clap.png"].axes
    assert np.asarray(axes.lines[0].get_xydata()) == pytest.approx(np.array([curve["steps"], curve["scores"]]).T)
    assert not list(tmp_path.glob("new.safetensors.*"))


def test_an_interrupted_edit_has_the_whole_curve(words, tmp_path, monkeypatch):
    def report(name: str) -> dict:
        found: dict = load(tmp_path / name).origin.report[EDITS][-1]["clap"]
        return found

    assert run_verb("edit", *words, "--output", str(tmp_path / "whole.safetensors")) == 0
    part = [*words, "--output", str(tmp_path / "part.safetensors")]
    with monkeypatch.context() as patched:
        interrupt_at(patched, 3)
        assert main(["edit", *part]) == 130
    save_clap(tmp_path / "other", seed=1)
    with raises(AvmsfError, file="part.safetensors.checkpoint", value=["network"]):
        run_verb("edit", *part, "--set", f"prompt.clap={tmp_path / 'other'}")
    assert run_verb("edit", *part) == 0
    assert report("part.safetensors") == report("whole.safetensors")
