"""From edits to the record of the protocol and its figures, with a tiny CLAP network of random weights."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from test_editing_protocol import QUICK, Generator, embedded, flat_space, struck

from avmsf.editing.config import DistillationConfig
from avmsf.evaluation.clap import Clap
from benchmarks import editingfigures
from benchmarks.editing import EditScore, EditTask, score_edits, towards_words, write_scores
from benchmarks.mode_embedding import MaterialSpace, pitches
from factories.made_clap import save_clap

PROMPT = "a glass is struck"
METHODS = ("audio-sds", "hierarchical")


class Answering(Generator):
    """A model that wants every sound half as loud towards its end."""

    def denoised(self, latents, level, conditioning, *, guidance):
        made = latents.clone()
        made[..., made.shape[-1] // 2 :] *= 0.5
        return made


def space_of_vectors(monkeypatch: pytest.MonkeyPatch) -> MaterialSpace:
    """Return a space whose embedding is two components of the vectors: UMAP would have to be compiled."""
    monkeypatch.setattr(MaterialSpace, "place", lambda self, bank: pitches(bank)[[0, 31]])
    space = flat_space("pitches")
    return embedded(space, space.vectors[:, [0, 31]])


@pytest.fixture
def judged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[MaterialSpace, Clap, tuple[EditScore, ...]]:
    pytest.importorskip("transformers", reason="needs pip install 'avmsf[eval]'")
    save_clap(tmp_path / "clap")
    clap, space = Clap.load(tmp_path / "clap"), space_of_vectors(monkeypatch)
    settings = {**QUICK, "preview_every": 2}
    before, _, *guided = towards_words(Answering(), settings, distillation=DistillationConfig(denoising=1))
    task = EditTask(struck("ceramic"), "glass", prompt=PROMPT)
    return space, clap, score_edits([task], (before, *guided), {"pitches": space}, clap=clap)


def test_scores_hold_the_places_and_the_clap_score_of_every_preview(
    judged: tuple[MaterialSpace, Clap, tuple[EditScore, ...]],
) -> None:
    space, clap, scores = judged
    before, *others = scores
    assert [each.method for each in others] == list(METHODS)
    assert before.clap_curve == ()
    assert before.places["pitches"] == pytest.approx(space.place(struck("ceramic").bank), abs=1e-6)
    for each in scores:
        apart = np.asarray(each.places["pitches"]) - space.center("glass")
        assert each.umap["pitches"] == pytest.approx(float(np.linalg.norm(apart)))
    # Of the object as it was, wherever it is loudest.
    known = struck("ceramic").sound_field
    rendered = known.render(known.gain_field.points)
    alone = clap.score(rendered, [PROMPT], sample_rate=known.sample_rate).tolist()
    for each in others:
        # Every second of three steps, and the last one.
        assert [step for step, _ in each.clap_curve] == [0, 2, 3]
        assert min(abs(each.clap_curve[0][1] - score) for score in alone) < 1e-6
        assert len({score for _, score in each.clap_curve}) == 3


def test_a_record_is_drawn_without_editing(
    judged: tuple[MaterialSpace, Clap, tuple[EditScore, ...]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    space, _, scores = judged
    write_scores(scores, {"pitches": space}, tmp_path / "record.json")
    drawn: dict[str, Figure] = {}
    save = editingfigures.save_picture

    def keep(figure: Figure, path: Path) -> None:
        drawn[path.name] = figure
        save(figure, path)

    monkeypatch.setattr(editingfigures, "save_picture", keep)
    assert editingfigures.main([str(tmp_path / "record.json"), str(tmp_path / "figures")]) == 0
    assert list(drawn) == ["umap-pitches-ceramic-to-glass.png", "clap.png"]
    assert all((tmp_path / "figures" / name).read_bytes().startswith(b"\x89PNG") for name in drawn)
    panels = drawn["umap-pitches-ceramic-to-glass.png"].axes
    assert [axes.get_title() for axes in panels] == list(METHODS)
    for axes, score in zip(panels, scores[1:], strict=True):
        points = np.concatenate([np.asarray(each.get_offsets()) for each in axes.collections])
        assert sorted(points.tolist()) == pytest.approx(np.array(sorted(space.embedding.tolist())))
        ends = {str(line.get_label()): np.asarray(line.get_xydata()) for line in axes.lines}
        assert ends["before the edit"] == pytest.approx(np.array([scores[0].places["pitches"]]))
        assert ends["after the edit"] == pytest.approx(np.array([score.places["pitches"]]))
    (axes,) = drawn["clap.png"].axes
    lines = [np.asarray(line.get_xydata()) for line in axes.lines if str(line.get_label()).startswith("_")]
    for line, score in zip(lines, scores[1:], strict=True):
        assert line == pytest.approx(np.array(score.clap_curve))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"scores": [{}], "spaces": {}}'])
def test_another_file_is_no_record(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "other.json").write_text(text, encoding="utf-8")
    assert editingfigures.main([str(tmp_path / "other.json"), str(tmp_path / "figures")]) == 2
    assert "other.json" in capsys.readouterr().err
