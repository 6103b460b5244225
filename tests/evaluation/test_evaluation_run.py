"""Running an evaluation: kept as it goes, gone on with, never mixed, and the same however it is run."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from avmsf.capture import read_capture
from avmsf.datasets import CaptureCollection
from avmsf.errors import AvmsfError, EvaluationError, FitError
from avmsf.evaluation.case_run import Evaluation
from avmsf.evaluation.methods import FunctionMethod, method_named
from avmsf.evaluation.modal_metrics import ModalRenderer, compare_modes, truth_at
from avmsf.evaluation.objects import ObjectInputs, draw_other_recording
from avmsf.evaluation.registry import PROTOCOLS
from avmsf.evaluation.report import write_summary
from avmsf.evaluation.results import ENCODER, ResultsFolder
from avmsf.evaluation.runner import Progress, run_objects
from avmsf.evaluation.scores import MetricSettings
from avmsf.evaluation.simple_methods import NearestRecording
from avmsf.evaluation.splits import evenly_spaced, split
from avmsf.evaluation.task import Method, Renderer, Task
from avmsf.simulate.ground_truth import TRUTH, read_truth, write_truth
from factories.plate_set import PlateInputs, fill_plates
from factories.raising import raises

CHEAP = ("white-noise", "nearest", "knn3", "random-impact")


@pytest.fixture(scope="module")
def plates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill_plates(tmp_path_factory.mktemp("plates"))


def planned(folder: Path, *methods: str | Method, protocol: str = "farthest", seed: int = 0) -> Evaluation:
    chosen = tuple(method_named(each) if isinstance(each, str) else each for each in methods or CHEAP)
    dataset = CaptureCollection(folder)
    return Evaluation(
        dataset,
        "plates",
        PROTOCOLS[protocol],
        chosen,
        PlateInputs(),
        seed=seed,
        metric_settings=MetricSettings(cdpam=False),
    )


def summed(results: Path) -> dict:
    return write_summary(ResultsFolder(results), subsets={})


def asking(ask: Callable[[Task], object], name: str = "asking") -> FunctionMethod:
    """Return the nearest recording, after something has been done with the task."""

    def fit(task: Task) -> Renderer:
        ask(task)
        return NearestRecording(task.train)

    return FunctionMethod(name, fit)


def failing(error: BaseException) -> FunctionMethod:
    def fail(task: Task) -> None:
        raise error

    return asking(fail, "failing")


def test_what_is_done_is_not_done_again_and_more_may_be_added(plates: Path, tmp_path: Path) -> None:
    results = ResultsFolder(tmp_path)
    fitted: list[str] = []
    counting = asking(lambda task: fitted.append(task.name))
    run_objects(planned(plates, counting), ("a",), results)
    run_objects(planned(plates, counting, "knn3"), ("a", "b"), results)
    assert fitted == ["a", "b"]
    assert sorted(results.identity()["methods"]) == ["asking", "knn3"]
    assert [record.identifier for record in results.records()] == ["a", "b"]
    assert all(len(record.outcomes) == 2 for record in results.records())


@pytest.mark.parametrize("fault", [FitError("no\n fit"), ZeroDivisionError("by zero")])
def test_a_failing_method_stops_no_other_and_is_tried_again(plates: Path, tmp_path: Path, fault: Exception) -> None:
    results = ResultsFolder(tmp_path)
    run_objects(planned(plates, failing(fault), "knn3"), ("a", "b"), results)
    summary = summed(tmp_path)
    told = "no fit" if isinstance(fault, AvmsfError) else "ZeroDivisionError: by zero"
    assert [each["failure"] for each in summary["failures"]] == [told, told]
    assert set(summary["methods"]) == {"knn3"}
    kept = [each.failure or "" for each in results.read("a").outcomes if each.method == "failing"]
    # A fault of the program keeps the place where it happened.
    assert ["in fit" in failure for failure in kept] == [not isinstance(fault, AvmsfError)]
    run_objects(planned(plates, asking(str, "failing"), "knn3"), ("a", "b"), results)
    summary = summed(tmp_path)
    assert summary["failures"] == []
    assert set(summary["methods"]) == {"knn3", "failing"}


def test_changed_wavs_are_scored_again_and_no_others(plates: Path, tmp_path: Path) -> None:
    results, sounds = ResultsFolder(tmp_path / "results"), tmp_path / "sounds"
    for name in ("a", "b"):
        shutil.copytree(plates / name, sounds / name)
    tested = {name: split(read_capture(plates / name).impacts, 0.2)[1].names for name in ("a", "b")}
    changing, missing = sounds / "a" / tested["a"][0], sounds / "b" / tested["b"][0]
    content = missing.read_bytes()
    missing.unlink()
    evaluation = planned(plates, f"recorded:{sounds}")
    run_objects(evaluation, ("a", "b"), results)
    (failure,) = summed(results.path)["failures"]
    assert failure["object"] == "b"
    first = results.read("a")
    missing.write_bytes(content)
    run_objects(evaluation, ("a", "b"), results)
    assert summed(results.path)["failures"] == []
    assert results.read("a") == first
    shutil.copy(sounds / "a" / tested["a"][1], changing)
    run_objects(evaluation, ("a", "b"), results)
    changed = results.read("a")
    assert first is not None
    assert changed is not None
    errors = [sum(each.outcomes[0].values["relative_stft"]) for each in (first, changed)]
    assert errors[0] < 1e-3 < errors[1]


def test_an_interruption_keeps_all_before_it(plates: Path, tmp_path: Path) -> None:
    results = ResultsFolder(tmp_path)
    stopped = failing(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run_objects(planned(plates, "knn3", stopped, "nearest"), ("a", "b"), results)
    (record,) = results.records()
    assert [each.method for each in record.outcomes] == ["knn3"]


def test_an_object_that_cannot_be_read_or_shows_nothing_is_a_failure(plates: Path, tmp_path: Path) -> None:
    folder = fill_plates(tmp_path / "data", ("a", "b"))
    (folder / "b" / "03.wav").unlink()
    run_objects(planned(folder, "knn3", "field"), ("a", "b"), ResultsFolder(tmp_path / "results"))
    failures = summed(tmp_path / "results")["failures"]
    assert [(each["object"], each["method"]) for each in failures] == [("a", "field"), ("b", None)]
    assert "nothing shows its look" in failures[0]["failure"]
    assert "03.wav" in failures[1]["failure"]


def test_a_truth_of_other_recordings_costs_its_object_alone_until_it_is_mended(tmp_path: Path) -> None:
    folder = fill_plates(tmp_path / "plates", ("a", "b"), count=6, truth=True)
    truth = read_truth(folder / "a")
    write_truth(replace(truth, names=tuple(f"x{name}" for name in truth.names)), folder / "a" / TRUTH)
    results = ResultsFolder(tmp_path / "results")
    run_objects(planned(folder, "nearest"), ("a", "b"), results)
    assert [len(each.outcomes) for each in results.records()] == [0, 1]
    (folder / "a" / TRUTH).unlink()
    run_objects(planned(folder, "nearest"), ("a", "b"), results)
    assert [(len(each.outcomes), each.failure) for each in results.records()] == [(1, None), (1, None)]


def test_methods_share_modes_that_are_found_once_and_kept(plates: Path, tmp_path: Path) -> None:
    found = []
    evaluation = planned(plates, asking(lambda task: found.append(task.modes()), "one"))
    run_objects(evaluation, ("a",), ResultsFolder(tmp_path))
    again = planned(plates, *(asking(lambda task: found.append(task.modes()), name) for name in ("two", "three")))
    run_objects(again, ("a",), ResultsFolder(tmp_path))
    assert found[1] is found[2]
    assert torch.equal(found[0].bank.frequency, found[1].bank.frequency)
    assert [path.name for path in (tmp_path / "modes" / "a").iterdir()] == ["01.safetensors"]
    assert found[0].gains.shape[0] == 2


def test_one_shot_has_modes_too(plates: Path, tmp_path: Path) -> None:
    counts = []
    method = asking(lambda task: counts.append((len(task.train), len(task.modes().gains))))
    run_objects(planned(plates, method, protocol="shots"), ("a",), ResultsFolder(tmp_path))
    assert counts == [(8, 8), (4, 4), (2, 2), (1, 1)]


def test_shared_time_is_no_methods_time(plates: Path, tmp_path: Path) -> None:
    class SlowInputs(PlateInputs):
        def features(self, *arguments: object, **named: object):  # type: ignore[no-untyped-def]
            time.sleep(0.2)
            return super().features(*arguments, **named)

    method = asking(lambda task: task.features("positions"))
    run_objects(replace(planned(plates, method), inputs=SlowInputs()), ("a",), ResultsFolder(tmp_path))
    (record,) = ResultsFolder(tmp_path).records()
    assert record.outcomes[0].fit_seconds < record.cases[0].shared_seconds
    assert record.cases[0].shared_seconds >= 0.2


def refusals(plates: Path, other: Path) -> dict[str, Evaluation]:
    """Return evaluations that differ, by what differs; "a" is an object of other recordings."""
    plan = planned(plates, "knn3")
    return {
        "protocol": planned(plates, "knn3", protocol="closest"),
        "seed": planned(plates, "knn3", seed=1),
        "dataset": replace(plan, title="plots"),
        "metrics.cdpam_contacts": replace(plan, metric_settings=MetricSettings(cdpam=False, cdpam_contacts=3)),
        "settings.views": replace(plan, settings={"views": 3}),
        "a": planned(other, "knn3"),
    }


def test_results_of_different_evaluations_are_not_mixed(
    plates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = fill_plates(tmp_path / "other", ("x", "a"))
    results = ResultsFolder(tmp_path / "results")
    run_objects(planned(plates, "knn3"), ("a",), results)
    before = (tmp_path / "results" / "objects" / "a.json").read_bytes()
    held = results.identity()
    known = {**held, "metrics.cdpam_contacts": 8, "settings.views": None}
    for name, evaluation in refusals(plates, other).items():
        with raises(EvaluationError, file=results.path, name=name) as caught:
            run_objects(evaluation, ("a",), results)
        assert name == "a" or caught.value.value == known[name]
    changed = replace(asking(str, "knn3"), weights="others")
    with raises(EvaluationError, file=results.path, name="knn3", value=held["methods"]["knn3"]):
        run_objects(planned(plates, changed), ("a",), results)
    monkeypatch.setattr("avmsf.evaluation.case_run.source_digest", lambda module: "of other code")
    with raises(EvaluationError, file=results.path, name="source", value=held["source"]):
        run_objects(planned(plates, "knn3"), ("a",), results)
    assert (tmp_path / "results" / "objects" / "a.json").read_bytes() == before


def test_a_folder_of_other_things_and_damaged_results_are_refused(plates: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with raises(EvaluationError, file=tmp_path / "mine", name="output"):
        run_objects(planned(plates), ("a",), ResultsFolder(tmp_path / "mine"))
    results = ResultsFolder(tmp_path / "results")
    run_objects(planned(plates, "knn3"), ("a",), results)
    for content in ("{", "[]", '{"identifier": "a"}'):
        (tmp_path / "results" / "objects" / "a.json").write_text(content)
        with raises(EvaluationError, file="objects/a.json"):
            results.records()


def test_another_encoder_is_named_by_its_option(tmp_path: Path) -> None:
    results = ResultsFolder(tmp_path)
    results.begin({"protocol": "farthest"}, {"field": f"Field(width=3){ENCODER}descriptors"})
    with raises(EvaluationError, name="field") as caught:
        results.begin({"protocol": "farthest"}, {"field": f"Field(width=3){ENCODER}facebook/dinov2-base"})
    assert "--set lift.encoder=descriptors" in str(caught.value)
    assert "width" not in str(caught.value)
    with raises(EvaluationError, name="field") as caught:
        results.begin({"protocol": "farthest"}, {"field": f"Field(width=4){ENCODER}descriptors"})
    assert "width" not in str(caught.value)


def test_a_hidden_part_that_a_kill_left_is_no_other_thing(tmp_path: Path) -> None:
    (tmp_path / ".protocol.json.x.part").write_text("{")
    ResultsFolder(tmp_path).begin({"protocol": "farthest"}, {})
    assert ResultsFolder(tmp_path).identity() == {"protocol": "farthest", "methods": {}}


def test_another_recording_is_of_another_object_at_this_ones_rate_and_length(plates: Path) -> None:
    dataset = CaptureCollection(plates)
    train = read_capture(plates / "a").impacts
    drawn = draw_other_recording(dataset, "a", train, seed=3)
    others = torch.cat([read_capture(plates / name).impacts.sounds for name in "bc"])
    assert (others == drawn).all(dim=1).any()
    assert torch.equal(drawn, draw_other_recording(dataset, "a", train, seed=3))
    assert any(not torch.equal(drawn, draw_other_recording(dataset, "a", train, seed=seed)) for seed in range(4, 8))
    # Half the rate and twice the length: resampled, then silence.
    slow = replace(train, sample_rate=4000.0, sounds=torch.zeros(10, 1500))
    drawn = draw_other_recording(dataset, "a", slow, seed=3)
    assert drawn.shape == (1500,)
    assert float(drawn[1001:].abs().max()) == 0.0 < float(drawn[:1000].abs().max())
    with raises(EvaluationError, name="a"):
        draw_other_recording(CaptureCollection(plates / "a"), "a", train, seed=0)


@pytest.mark.parametrize(("count", "wanted"), [(10, 3), (3, 3), (2, 8), (7, 1), (33, 8)])
def test_spread_rows_are_distinct_and_within(count: int, wanted: int) -> None:
    rows = evenly_spaced(count, wanted)
    assert len(set(rows)) == len(rows) == min(count, wanted)
    assert rows == sorted(rows)
    assert set(rows) <= set(range(count))


def test_methods_with_modes_are_judged_by_the_truth(tmp_path: Path) -> None:
    folder = fill_plates(tmp_path / "plates", ("a",), truth=True)
    run_objects(planned(folder, "knn3", "spline-gains"), ("a",), ResultsFolder(tmp_path / "results"))
    (record,) = ResultsFolder(tmp_path / "results").records()
    waveform, spline = record.outcomes
    assert waveform.figures == {}
    (case,) = record.cases
    truth = truth_at(read_truth(folder / "a"), case.test)
    train, test = split(read_capture(folder / "a").impacts, 0.2)
    asked: list[Task] = []
    run_objects(planned(folder, asking(asked.append)), ("a",), ResultsFolder(tmp_path / "again"))
    fitted = method_named("spline-gains").fit(replace(asked[0], train=train))
    assert isinstance(fitted, ModalRenderer)
    expected = compare_modes(fitted, test.contacts, truth).figures()
    # Modes that are found again differ in their last digits.
    assert spline.figures == pytest.approx(expected, rel=1e-5)
    with raises(EvaluationError, name="names", value=("x.wav",)):
        truth_at(read_truth(folder / "a"), ("x.wav",))


def test_one_test_contact_has_no_mac(tmp_path: Path) -> None:
    folder = fill_plates(tmp_path / "plates", ("a",), count=4, truth=True)
    run_objects(planned(folder, "spline-gains", protocol="leave-one-out"), ("a",), ResultsFolder(tmp_path / "results"))
    (record,) = ResultsFolder(tmp_path / "results").records()
    assert len(record.outcomes) == 4
    assert all("gain_error" in each.figures and "mac" not in each.figures for each in record.outcomes)


def test_cdpam_is_taken_of_a_few_contacts(plates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Ear:
        def distance(self, predicted: torch.Tensor, truth: torch.Tensor, *, sample_rate: float) -> torch.Tensor:
            assert sample_rate == 8000.0
            return (predicted - truth).abs().sum(1).double()

    monkeypatch.setattr("avmsf.evaluation.scores._cdpam", Ear)
    evaluation = replace(planned(plates, "nearest"), metric_settings=MetricSettings(level="raw", cdpam_contacts=3))
    run_objects(evaluation, ("a",), ResultsFolder(tmp_path))
    (record,) = ResultsFolder(tmp_path).records()
    train, test = split(read_capture(plates / "a").impacts, 0.2)
    expected = (NearestRecording(train).render(test.contacts) - test.sounds).abs().sum(1)
    values = record.outcomes[0].values["cdpam"]
    assert [row for row, value in enumerate(values) if value is not None] == [1, 4, 6]
    assert [values[row] for row in (1, 4, 6)] == pytest.approx(expected[[1, 4, 6]].tolist(), rel=1e-6)


def test_at_full_scale_the_recordings_unit_does_not_matter(plates: Path, tmp_path: Path) -> None:
    impacts = read_capture(plates / "a").impacts
    train, test = split(impacts, 0.2)
    sounds, loudest = NearestRecording(train).render(test.contacts), float(impacts.sounds.abs().max())
    values = partial(MetricSettings(cdpam=False).values, NearestRecording(train), truth=None)
    one, _ = values(sounds, test, loudest=loudest)
    other, _ = values(1e-3 * sounds, replace(test, sounds=1e-3 * test.sounds), loudest=1e-3 * loudest)
    raw, _ = MetricSettings(level="raw", cdpam=False).values(
        NearestRecording(train), sounds, test, None, loudest=loudest
    )
    for metric in ("l1", "envelope"):
        assert other[metric] == pytest.approx(one[metric], rel=1e-4)
        assert raw[metric] == pytest.approx([loudest * each for each in one[metric]], rel=1e-4)


KILLED = """
import os, random, signal, sys, time
from pathlib import Path
sys.path[:0] = [sys.argv[1], f"{sys.argv[1]}/evaluation"]
from test_evaluation_run import evaluate_plates
chance = random.Random(0)
for _ in range(5):
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        evaluate_plates(Path(sys.argv[2]), Path(sys.argv[3]), lambda *progress: os.write(write, b"."))
        os._exit(0)
    os.close(write)
    for _ in range(chance.randint(3, 12)):
        os.read(read, 1)
    time.sleep(chance.uniform(0, 0.02))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    os.close(read)
    print(sum(path.read_text().count('"method"') for path in Path(sys.argv[3]).glob("objects/[!.]*.json")))
"""
"""Begins an evaluation five times, and kills it at a random moment after it has begun a random number of methods."""


def evaluate_plates(data: Path, results: Path, progress: Progress = lambda *event: None) -> None:
    evaluation = planned(data, protocol="leave-one-out")
    run_objects(evaluation, evaluation.dataset.objects(), ResultsFolder(results), progress=progress)
    summed(results)


@pytest.mark.slow
def test_killed_five_times_it_comes_to_the_same_summary(tmp_path: Path) -> None:
    plates = fill_plates(tmp_path / "plates", count=6)
    evaluate_plates(plates, tmp_path / "whole")
    place = tmp_path / "killed"
    command = [sys.executable, "-c", KILLED, str(Path(__file__).parents[1]), str(plates), str(place)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    # The kills came midway, not before or after all work, and nothing that was there was lost.
    counts = [int(word) for word in ran.stdout.split()]
    assert counts == sorted(counts)
    assert 0 < counts[0] < counts[4] < 3 * 6 * len(CHEAP)
    assert not (place / "summary.json").exists()
    evaluate_plates(plates, place)
    whole, resumed = (json.loads((folder / "summary.json").read_text()) for folder in (tmp_path / "whole", place))
    assert resumed == whole
    assert set(whole["methods"]) == set(CHEAP)


@pytest.mark.slow
def test_many_at_a_time_come_to_the_same_figures(plates: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    heard: list[int] = []
    evaluation = planned(plates, *CHEAP, "spline-gains")
    # Workers find what the package holds, and not what lies beside the tests.
    dataset, kept = evaluation.dataset, tmp_path / "features"
    evaluation = replace(evaluation, inputs=ObjectInputs(dataset, kept))
    objects = evaluation.dataset.objects()
    run_objects(evaluation, objects, ResultsFolder(tmp_path / "one"))
    many = ResultsFolder(tmp_path / "many")
    run_objects(evaluation, objects, many, workers=2, progress=lambda message, done, total: heard.append(done))
    assert heard == [0, 1, 2, 3]
    one, other = summed(tmp_path / "one"), summed(tmp_path / "many")
    for method, figures in one["methods"].items():
        assert other["methods"][method] == pytest.approx(figures, rel=1e-6)
    assert one["failures"] == other["failures"] == []


def test_without_ray_the_extra_is_named(plates: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with raises(EvaluationError, name="ray") as caught:
        run_objects(planned(plates), ("a",), ResultsFolder(tmp_path), workers=2)
    assert "pip install 'avmsf[scale]'" in str(caught.value)
    with raises(EvaluationError, name="workers", value=0):
        run_objects(planned(plates), ("a",), ResultsFolder(tmp_path), workers=0)
