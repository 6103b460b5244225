"""`avmsf evaluate --figures`: one picture for each object, drawn from stored results."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from avmsf.evaluation import report
from avmsf.evaluation.results import ResultsFolder
from factories.plate_field import RATE
from factories.plate_set import fill_plates
from factories.verbs import run_verb

CHEAP = ("--methods", "knn3,nearest", "--no-cdpam")


def test_stored_results_are_drawn_without_evaluating(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plates, results = fill_plates(tmp_path / "plates", ("a", "b")), tmp_path / "results"
    words = ["farthest", str(plates), *CHEAP, "--output", str(results)]
    assert run_verb("evaluate", *words) == 0
    assert not (results / "figures").exists()
    drawn: dict[str, Figure] = {}
    save = report.save_picture

    def keep(figure: Figure, path: Path) -> None:
        drawn[path.name] = figure
        save(figure, path)

    monkeypatch.setattr(report, "save_picture", keep)
    monkeypatch.setattr(
        "avmsf.evaluation.runner.CaseRun.outcome", lambda *_, **__: pytest.fail("a method was run again")
    )
    assert run_verb("evaluate", *words, "--figures") == 0
    assert list(drawn) == ["a.png", "b.png"]
    for name, figure in drawn.items():
        assert (results / "figures" / name).read_bytes().startswith(b"\x89PNG")
        record = ResultsFolder(results).read(name.removesuffix(".png"))
        assert record is not None
        panels = [axes for axes in figure.axes if axes.get_yscale() == "log"]
        assert len(panels) == 3 * len(record.cases[0].sounds)
        assert panels[0].get_ylim() == pytest.approx((20.0, 0.5 * RATE))
