"""Evaluations from the command line, and their figures."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from avmsf.cli import main, options_of
from avmsf.errors import AvmsfError, EvaluationError, FitError
from avmsf.evaluation import report
from avmsf.evaluation.methods import FieldMethod
from avmsf.evaluation.plan import Evaluation
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.task import Task
from avmsf.modal.extraction.stft import ShortTime
from factories.plate_field import RATE
from factories.plate_set import fill_plates
from factories.raising import raises
from factories.verbs import Streams, results_of, run_verb, sets

CHEAP = ("--methods", "knn3,nearest", "white-noise", "--no-cdpam")


@pytest.fixture(scope="module")
def plates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill_plates(tmp_path_factory.mktemp("place") / "plates", ("a", "b"))


def test_a_dataset_becomes_tables_and_a_page(plates: Path, tmp_path: Path, capsys: Streams) -> None:
    words = [str(plates), *CHEAP, "--output", str(tmp_path / "results")]
    printed, _ = results_of(capsys, "evaluate", "farthest", *words)
    kept = json.loads((tmp_path / "results" / "summary.json").read_text())
    assert {key: printed[key] for key in kept} == kept
    assert list(kept["methods"]) == ["knn3", "nearest", "white-noise"]
    assert set(kept["methods"]["knn3"]) == {"l1", "l1_log", "envelope", "relative_stft"}
    assert kept["ratio_to_knn3"]["knn3"]["l1"] == 1.0
    assert (kept["dataset"], kept["objects"], kept["test_contacts"]) == ("plates", 2, 16)
    assert "# farthest on plates" in (tmp_path / "results" / "report.md").read_text()
    before = (tmp_path / "results" / "objects" / "a.json").read_bytes()
    assert run_verb("evaluate", "farthest", *words) == 0
    assert (tmp_path / "results" / "objects" / "a.json").read_bytes() == before
    with raises(AvmsfError, file=tmp_path / "results", name="protocol", value="farthest"):
        run_verb("evaluate", "closest", *words)


def test_one_capture_and_one_object_will_do(plates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_verb("evaluate", "shots", str(plates / "a"), *CHEAP) == 0
    summary = json.loads((tmp_path / "evaluation" / "a" / "shots" / "summary.json").read_text())
    assert list(summary["cases"]) == ["8 shots", "4 shots", "2 shots", "1 shot"]
    words = [str(plates / "a"), *CHEAP, "--counts", "3", "--starts", "2", "--output", "three"]
    assert run_verb("evaluate", "shots", *words) == 0
    assert list(json.loads((tmp_path / "three" / "summary.json").read_text())["cases"]) == ["3 shots"]
    assert run_verb("evaluate", "farthest", str(plates), "--objects", "b", *CHEAP) == 0
    summary = json.loads((tmp_path / "evaluation" / "plates" / "farthest" / "summary.json").read_text())
    assert summary["objects"] == 1


WRONG = {
    "farthest plates --methods knn3,fild": ("method", "fild"),
    "farthest plates --objects c": ("object", "c"),
    "predefined plates": ("--test", None),
    "farthest plates --workers 0": ("workers", 0),
    "shots plates --counts 0 3": ("counts", [0, 3]),
    "shots plates --starts 0": ("starts", 0),
    "farthest plates --cdpam-contacts -1": ("cdpam_contacts", -1),
    "non-symmetric plates": ("subset", "non-symmetric"),
    "edit plates --objects a,b --methods unedited --output results": ("edit", (0, 0)),
    "farthest plates --device nothing": ("device", "nothing"),
    "farthest plates --device meta": ("device", "meta"),
}


def test_files_are_of_one_set_of_training_recordings(plates: Path, tmp_path: Path) -> None:
    method = f"recorded:{plates}"
    words = ["shots", str(plates), "--methods", f"knn3,{method}", "--output", str(tmp_path / "results")]
    with raises(EvaluationError, name="method", value=method):
        run_verb("evaluate", *words)
    options_of("evaluate", ["closest", *words[1:]]).check_inputs()


@pytest.mark.parametrize("words", WRONG)
def test_what_is_wrong_is_said_before_anything_is_written(words, plates, tmp_path, monkeypatch):
    monkeypatch.chdir(plates.parent)
    before = sorted(path.name for path in plates.parent.iterdir())
    name, value = WRONG[words]
    with raises(AvmsfError, name=name, value=value):
        run_verb("evaluate", *words.split())
    with raises(AvmsfError, file="nowhere"):
        run_verb("evaluate", "farthest", "nowhere")
    assert sorted(path.name for path in plates.parent.iterdir()) == before


def test_all_methods_hear_the_start_of_sounds_and_share_the_modes_that_are_asked_for(tmp_path, capsys, monkeypatch):
    plates, results = fill_plates(tmp_path / "plates", ("a",), truth=True), tmp_path / "results"
    words = ["farthest", str(plates), "--methods", "knn-gains,paper", "--no-cdpam"]
    words += [*sets("extraction=short-time lift.encoder=descriptors"), "--output", str(results)]
    heard = []

    def stop(field: FieldMethod, task: Task) -> None:
        heard.append(task.train.sounds)
        raise FitError("left out")

    monkeypatch.setattr(FieldMethod, "fit", stop)
    assert run_verb("evaluate", *words, "--time-zero", "peak") == 1
    assert "--time-zero" not in capsys.readouterr().err
    assert bool((heard[0][:, 0].abs() == heard[0].abs().amax(1)).all())
    # What peaks do to phases, no truth tells.
    summary = json.loads((results / "summary.json").read_text())
    assert "relative_stft" in summary["methods"]["knn-gains"]
    assert "gain_error" not in summary["methods"]["knn-gains"]
    assert ResultsFolder(results).identity()["modes"] == {"kind": "ShortTime", **asdict(ShortTime(128))}
    with raises(EvaluationError, name="time_zero", value="peak"):
        run_verb("evaluate", *words)
    assert run_verb("evaluate", *words[:-1], str(tmp_path / "others"), "--time-zero", "onset") == 1
    assert "--time-zero peak" in capsys.readouterr().err
    summary = json.loads((tmp_path / "others" / "summary.json").read_text())
    assert "gain_error" in summary["methods"]["knn-gains"]


def test_no_figure_at_all_is_an_error(plates: Path, tmp_path: Path) -> None:
    with raises(AvmsfError, file=tmp_path / "r", name="failures", value=2):
        run_verb(
            "evaluate", "farthest", str(plates), "--methods", "field", "--no-cdpam", "--output", str(tmp_path / "r")
        )


def test_ctrl_c_keeps_what_is_there(plates, tmp_path, capsys, monkeypatch):
    from avmsf.evaluation.simple_methods import NearestRecording

    def stop(self: NearestRecording, contacts: object, **how: object) -> None:
        raise KeyboardInterrupt

    words = ["farthest", str(plates), *CHEAP, "--output", str(tmp_path / "results")]
    with monkeypatch.context() as patched:
        patched.setattr(NearestRecording, "render", stop)
        assert main(["evaluate", *words]) == 130
    assert capsys.readouterr().err.splitlines()[-1].startswith("avmsf evaluate: interrupted")
    kept = json.loads((tmp_path / "results" / "objects" / "a.json").read_text())
    assert [each["method"] for each in kept["outcomes"]] == ["knn3"]
    summary = json.loads((tmp_path / "results" / "summary.json").read_text())
    assert list(summary["methods"]) == ["knn3"]
    assert summary["missing"] == {"a": ["nearest", "white-noise"], "b": ["knn3", "nearest", "white-noise"]}
    assert "a (nearest, white-noise), b." in (tmp_path / "results" / "report.md").read_text().splitlines()[2]
    assert run_verb("evaluate", *words) == 0
    assert json.loads((tmp_path / "results" / "summary.json").read_text())["missing"] == {}


def test_settings_and_the_device_reach_the_evaluation(plates, tmp_path, monkeypatch):
    asked: list[Evaluation] = []

    def stop(evaluation: Evaluation, *objects: object, **settings: object) -> None:
        asked.append(evaluation)
        raise KeyboardInterrupt

    monkeypatch.setattr("avmsf.evaluation.runner.run_objects", stop)
    words = ["farthest", str(plates), *CHEAP, "--output", str(tmp_path / "results"), "--device", "cpu"]
    assert main(["evaluate", *words, *sets("body.wall=0 geometry=gaussians")]) == 130
    inputs = asked[0].inputs
    assert (inputs.body.wall, inputs.geometry, inputs.device) == (0.0, "gaussians", "cpu")
    # Figures of another wall are not these.
    assert asked[0].settings["body"]["wall"] == 0.0


FEW = ("--methods", "knn3,nearest", "--no-cdpam")


def test_stored_results_are_drawn_without_evaluating(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plates, results = fill_plates(tmp_path / "plates", ("a", "b")), tmp_path / "results"
    words = ["farthest", str(plates), *FEW, "--output", str(results)]
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
