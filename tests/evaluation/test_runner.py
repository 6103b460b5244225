"""Running an evaluation: kept as it goes, gone on with, never mixed, and the same however it is run."""

import json
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from avmsf._utils.processes import write_lock
from avmsf.capture import read_capture, write_capture
from avmsf.capture.audio import read_recording
from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.datasets import CaptureCollection, open_dataset
from avmsf.datasets.dataset import ObjectFacts
from avmsf.errors import AvmsfError, EvaluationError, FitError, FolderInUseError
from avmsf.evaluation import align_split, evaluate
from avmsf.evaluation.methods import FieldMethod, FunctionMethod, method_named
from avmsf.evaluation.modal_metrics import compare_modes, truth_at
from avmsf.evaluation.objects import ObjectInputs
from avmsf.evaluation.plan import Evaluation
from avmsf.evaluation.registry import METRICS, PROTOCOLS, MetricSettings, VisualInput
from avmsf.evaluation.report import write_summary
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.runner import CaseRun, ObjectData, Progress, run_objects
from avmsf.evaluation.simple_methods import NearestRecording
from avmsf.evaluation.splits import Case, split
from avmsf.evaluation.task import Method, Renderer, Task
from avmsf.features.feature_field import FeatureField
from avmsf.field.fit import fit as field_fit
from avmsf.field.gains.attention import Attention
from avmsf.field.gains.symmetry import Symmetric
from avmsf.field.sound_field import SoundField
from avmsf.mesh import Surface
from avmsf.modal.extraction.alignment import align
from avmsf.pipeline.config import PipelineConfig
from avmsf.pipeline.fit import fit
from avmsf.simulate.ground_truth import TRUTH, read_truth, write_truth
from factories.delayed_plate import delays, strikes
from factories.plate_field import QUICK, plate_fit
from factories.plate_set import PlateInputs, fill_plates, plate_named
from factories.raising import raises
from oracles.plate import plate_surface_points

CHEAP = ("white-noise", "nearest", "knn3", "random-impact")
NO_CDPAM = MetricSettings(cdpam=False)


@pytest.fixture(scope="module")
def plates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fill_plates(tmp_path_factory.mktemp("plates"))


def planned(folder: Path, *methods: str | Method, protocol: str = "farthest", seed: int = 0) -> Evaluation:
    chosen = tuple(method_named(each) if isinstance(each, str) else each for each in methods or CHEAP)
    inputs = PlateInputs(CaptureCollection(folder), folder, seed=seed)
    return Evaluation("plates", PROTOCOLS[protocol], chosen, inputs, NO_CDPAM)


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
    results, fitted = ResultsFolder(tmp_path), list[str]()
    counting = asking(lambda task: fitted.append(task.name))
    run_objects(planned(plates, counting), ("a",), results)
    run_objects(planned(plates, counting, "knn3"), ("a", "b"), results)
    assert fitted == ["a", "b"]
    assert sorted(results.identity()["methods"]) == ["asking", "knn3"]
    assert [(record.identifier, len(record.outcomes)) for record in results.records()] == [("a", 2), ("b", 2)]


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
    assert (summary["failures"], set(summary["methods"])) == ([], {"knn3", "failing"})


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
    errors = [sum(each.outcomes[0].values["relative_stft"]) for each in (first, results.read("a"))]
    assert errors[0] < 1e-3 < errors[1]


def test_without_a_body_the_default_method_is_the_fit_with_its_symmetries(plates: Path, tmp_path: Path) -> None:
    capture = read_capture(plates / "a")
    points = Surface(plate_surface_points(plate_named("a"), 400), torch.zeros(0, 3, dtype=torch.int64))
    write_capture(replace(capture, surface=points), tmp_path / "plates" / "a")
    tasks, dataset = list[Task](), CaptureCollection(tmp_path / "plates")
    plan = planned(plates, asking(tasks.append))
    run_objects(replace(plan, inputs=ObjectInputs(dataset, tmp_path)), ("a",), ResultsFolder(tmp_path / "results"))
    (task,) = tasks
    config = PipelineConfig("auto", fit=replace(QUICK, steps=3))
    evaluated = FieldMethod("field-auto", config, VisualInput()).fit(task)
    fitted = fit(replace(dataset.capture("a"), impacts=task.train, folder=None), config=config, progress=False)
    for field in (evaluated, fitted):
        assert Symmetric.kind in {each.kind for each in field.fitted_mixture.families}
    assert torch.equal(evaluated.render(task.contacts), fitted.render(task.contacts))
    assert (evaluated.origin.settings, evaluated.origin.config) == (fitted.origin.settings, fitted.origin.config)
    assert evaluated.origin.report["supporting_poles"] == fitted.origin.report["supporting_poles"]


def test_an_object_that_cannot_be_read_or_shows_nothing_is_a_failure(tmp_path: Path) -> None:
    folder = fill_plates(tmp_path / "data", ("a", "b"))
    (folder / "b" / "03.wav").unlink()
    run_objects(planned(folder, "knn3", "field"), ("a", "b"), ResultsFolder(tmp_path / "results"))
    failures = summed(tmp_path / "results")["failures"]
    assert [(each["object"], each["method"]) for each in failures] == [("a", "field"), ("b", None)]
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
    for names in (("one",), ("two", "three")):
        methods = (asking(lambda task: found.append(task.modes()), name) for name in names)
        run_objects(planned(plates, *methods), ("a",), ResultsFolder(tmp_path))
    assert found[1] is found[2]
    assert torch.equal(found[0].bank.frequency, found[1].bank.frequency)
    assert [path.name for path in (tmp_path / "modes" / "a").iterdir()] == ["01.safetensors"]
    counts = []
    method = asking(lambda task: counts.append((len(task.train), len(task.modes().gains))), "shots")
    run_objects(planned(plates, method, protocol="shots"), ("a",), ResultsFolder(tmp_path / "shots"))
    assert counts == [(8, 8), (4, 4), (2, 2), (1, 1)]


def test_results_of_different_evaluations_are_not_mixed(plates, tmp_path, monkeypatch):
    results, plan = ResultsFolder(tmp_path / "results"), planned(plates, "knn3")
    run_objects(plan, ("a",), results)
    before = (results.path / "objects" / "a.json").read_bytes()
    held = results.identity()
    others = {
        "protocol": (planned(plates, "knn3", protocol="closest"), "farthest"),
        "seed": (planned(plates, "knn3", seed=1), 0),
        "dataset": (replace(plan, title="plots"), "plates"),
        "metrics.cdpam_contacts": (replace(plan, metric_settings=replace(NO_CDPAM, cdpam_contacts=3)), 8),
        "settings.views": (replace(plan, settings={"views": 3}), None),
        "methods.knn3.settings": (
            planned(plates, replace(asking(str, "knn3"), weights="others")),
            held["methods"]["knn3"]["settings"],
        ),
        "a": (planned(fill_plates(tmp_path / "other", ("x", "a")), "knn3"), json.loads(before)["digest"]),
    }
    for name, (evaluation, value) in others.items():
        with raises(EvaluationError, file=results.path, name=name, value=value):
            run_objects(evaluation, ("a",), results)
    monkeypatch.setitem(METRICS, "peak", METRICS["l1"])
    monkeypatch.delitem(METRICS, "umap")
    with raises(EvaluationError, file=results.path, name="columns", value=held["columns"]):
        run_objects(plan, ("a",), results)
    monkeypatch.undo()
    monkeypatch.setattr("avmsf.evaluation.plan.source_digest", lambda module: "of other code")
    with raises(EvaluationError, file=results.path, name="source", value=held["source"]):
        run_objects(plan, ("a",), results)
    assert (results.path / "objects" / "a.json").read_bytes() == before


def test_a_folder_of_other_things_and_damaged_results_are_refused(plates: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with raises(EvaluationError, file=tmp_path / "mine", name="output"):
        run_objects(planned(plates), ("a",), ResultsFolder(tmp_path / "mine"))
    results = ResultsFolder(tmp_path / "results")
    # A hidden part that a kill left is no other thing.
    results.path.mkdir()
    (results.path / ".protocol.json.x.part").write_text("{")
    run_objects(planned(plates, "knn3"), ("a",), results)
    for content in ("{", "[]", '{"identifier": "a"}'):
        (results.path / "objects" / "a.json").write_text(content)
        with raises(EvaluationError, file="objects/a.json"):
            results.records()


def test_results_of_another_mesh_or_other_settings_are_not_mixed(tmp_path: Path) -> None:
    folder, results = fill_plates(tmp_path / "plates", ("a",), truth=True), ResultsFolder(tmp_path / "results")
    run_objects(planned(folder, "knn3"), ("a",), results)
    settings = folder / "a" / "capture.toml"
    settings.write_text(settings.read_text() + "held = [[0.0, 0.0, 0.0]]\n")
    with raises(EvaluationError, file=results.path, name="a"):
        run_objects(planned(folder, "knn3"), ("a",), results)


def test_of_short_files_that_start_at_their_peaks_what_they_hold_is_scored(tmp_path, monkeypatch):
    folder = fill_plates(tmp_path / "plates", ("a",), truth=True)
    (folder / "a" / "capture.toml").write_text('name = "a"\n')
    peaks, own = open_dataset(folder, time_zero="peak"), open_dataset(folder)
    assert peaks.capture("a").impacts.duration < own.capture("a").impacts.duration
    monkeypatch.setattr(FieldMethod, "fit", lambda method, task: NearestRecording(task.train))
    plan = replace(planned(folder, "field-smooth"), inputs=PlateInputs(peaks, folder), time_zero="peak", own_starts=own)
    run_objects(plan, ("a",), ResultsFolder(tmp_path / "results"))
    assert summed(tmp_path / "results")["failures"] == []
    # Each recording has a time zero of its own then, which the true gains have not.
    (folder / "a" / "capture.toml").write_text('time_zero = "peak"\n')
    assert ObjectData(planned(folder), "a").truth is None


def test_edits_among_other_objects_or_of_other_features_are_not_mixed(plates: Path, tmp_path: Path) -> None:
    def plan(names: str) -> Evaluation:
        materials = dict.fromkeys(names, "wood")
        edits = SimpleNamespace(spaces={}, materials=materials, field_method=method_named("field"))
        return replace(planned(plates, "unedited", protocol="edit"), edits=edits, encoder="descriptors")

    results = ResultsFolder(tmp_path / "results")
    plan("ab").begin(results)
    assert results.identity()["methods"]["unedited"]["encoder"] == "descriptors"
    with raises(EvaluationError, file=results.path, name="among.c"):
        plan("abc").begin(results)


def test_recordings_at_another_rate_are_refused_before_they_are_aligned() -> None:
    made = replace(plate_fit(replace(QUICK, warmup_steps=4, steps=2)), alignment=align(strikes(8, starts=delays(8))))
    with raises(EvaluationError, name="sample_rate"):
        evaluate(made, replace(strikes(8), sample_rate=2000.0))


def test_stored_sounds_have_the_recordings_rate(tmp_path: Path) -> None:
    run = run_of(strikes(STRIKES), tmp_path)
    run.stored_rows, rate = [0], run.scored.test.sample_rate
    (file,) = run._write_sounds("generation", torch.randn(1, 2000), 2 * rate).values()
    heard = read_recording(tmp_path / file)
    assert (heard.sample_rate, heard.frames) == (rate, 1000)


def test_two_evaluations_exclude_each_other_in_one_folder(plates: Path, tmp_path: Path) -> None:
    results = ResultsFolder(tmp_path / "results")
    run_objects(planned(plates, "knn3"), ("a",), results)
    with write_lock(results.path, ".results", command="avmsf evaluate"), ThreadPoolExecutor(1) as other:
        found = other.submit(run_objects, planned(plates, "nearest"), ("b",), results).exception()
    assert isinstance(found, FolderInUseError)
    assert [*results.identity()["methods"]] == ["knn3"]


def test_methods_with_modes_are_compared_with_the_truth(tmp_path: Path) -> None:
    folder, asked = fill_plates(tmp_path / "plates", ("a",), truth=True), list[Task]()
    results = ResultsFolder(tmp_path / "results")
    run_objects(planned(folder, "knn3", "spline-gains", asking(asked.append)), ("a",), results)
    (record,) = results.records()
    waveform, spline, _ = record.outcomes
    assert waveform.figures == {}
    train, test = split(read_capture(folder / "a").impacts, 0.2)
    fitted = method_named("spline-gains").fit(replace(asked[0], train=train))
    expected = compare_modes(fitted, test.contacts, truth_at(read_truth(folder / "a"), record.cases[0].test))
    # Modes that are found again differ in their last digits.
    assert spline.figures == pytest.approx(expected, rel=1e-5)
    # Gains at one contact agree with any others.
    few = fill_plates(tmp_path / "few", ("a",), count=4, truth=True)
    # The truth is the capture's, with or without what shows it.
    (few / "a" / "surface.ply").unlink()
    run_objects(planned(few, "spline-gains", protocol="leave-one-out"), ("a",), ResultsFolder(tmp_path / "one"))
    (record,) = ResultsFolder(tmp_path / "one").records()
    assert len(record.outcomes) == 4
    assert all("gain_error" in each.figures and "mac" not in each.figures for each in record.outcomes)


TRAIN, STRIKES = 12, 16


class Plate:
    """A dataset of one object."""

    name = "plates"

    def __init__(self, impacts: Impacts) -> None:
        self.impacts = impacts

    def capture(self, identifier: str) -> Capture:
        return Capture(identifier, self.impacts, None)

    def facts(self, identifier: str) -> ObjectFacts:
        return ObjectFacts(identifier, identifier)

    def visual_source(self, identifier: str) -> None:
        return None


def run_of(impacts: Impacts, folder: Path, own_starts: Impacts | None = None) -> CaseRun:
    own = None if own_starts is None else Plate(own_starts)
    inputs = PlateInputs(Plate(impacts), folder)
    evaluation = Evaluation("plates", PROTOCOLS["farthest"], (), inputs, NO_CDPAM, own_starts=own)
    case = Case("all", tuple(range(TRAIN)), tuple(range(TRAIN, STRIKES)))
    return CaseRun(evaluation, ObjectData(evaluation, "a"), case, folder=folder, number=1, stores_sounds=False)


class NearestThree:
    """The built-in knn3 as somebody else would write it."""

    def __init__(self, train: Impacts) -> None:
        self.train, self.sample_rate = train, train.sample_rate

    def render(self, contacts: Tensor, *, directions: Tensor | None = None) -> Tensor:
        nearest = torch.cdist(contacts, self.train.contacts).argsort(1)[:, :3]
        return self.train.sounds[nearest].mean(1)


def test_an_own_method_in_python_gets_the_score_of_the_same_built_in_one(tmp_path: Path) -> None:
    run = run_of(strikes(STRIKES, starts=delays(STRIKES)), tmp_path)
    train, test = run.scored.train, run.scored.test
    built_in = run.outcome(method_named("knn3"))
    own = evaluate(NearestThree, test, train=train)
    aligned = align_split(train, test)
    by_hand = evaluate(NearestThree(aligned[0]), aligned[1])
    for metric, values in own.values.items():
        assert by_hand.values[metric].tolist() == pytest.approx(values.tolist(), rel=1e-6), metric
    assert own.values["relative_stft"].tolist() == pytest.approx(built_in.values["relative_stft"], rel=1e-6)
    # What this is for: recordings as they are give another score.
    assert evaluate(NearestThree(train), test).mean()["relative_stft"] > 1.02 * own.mean()["relative_stft"]


def test_fields_are_fitted_to_own_starts_and_all_are_scored_from_the_peaks(tmp_path, monkeypatch):
    own = strikes(STRIKES, starts=delays(STRIKES))
    peaks = own.delayed(own.sounds.abs().argmax(1).double())
    run, fitted = run_of(peaks, tmp_path, own), []

    def fit(method: FieldMethod, task: Task) -> NearestRecording:
        fitted.append(task.train.sounds)
        return NearestRecording(task.train)

    monkeypatch.setattr(FieldMethod, "fit", fit)
    ours, published, nearest = (run.outcome(method_named(name)) for name in ("field-smooth", "paper", "nearest"))
    assert ours.failure is None
    assert torch.equal(fitted[0], run.own.modes().aligned(own.take(range(TRAIN))).sounds)
    assert torch.equal(fitted[1], peaks.take(range(TRAIN)).sounds)
    assert published.values["relative_stft"] == nearest.values["relative_stft"] != ours.values["relative_stft"]


def test_a_field_is_fitted_once_for_all_methods_of_a_case_and_its_time_is_its_own(tmp_path, monkeypatch):
    fitted = list[str]()

    def trained(method: FieldMethod, task: Task) -> SoundField:
        fitted.append(method.name)
        task.gaussians()
        points = FeatureField.from_contacts(task.train.contacts, count=60)
        return field_fit(task.train, points, task.modes(), replace(QUICK, steps=1), gains=Attention())

    monkeypatch.setattr(FieldMethod, "fit", trained)
    run = run_of(strikes(STRIKES), tmp_path)
    # What methods share is counted once, also where one asks for it by way of another.
    monkeypatch.setattr(run.data, "gaussians", lambda views: time.sleep(0.3))
    methods = asking(lambda task: task.field("paper")), method_named("paper"), method_named("paper-mean-gains")
    outcomes = [run.outcome(method) for method in methods]
    assert [each.failure for each in outcomes] == [None] * 3
    assert fitted == ["paper"]
    before, paper, after = (each.fit_seconds for each in outcomes)
    assert paper > max(before, after)


@pytest.mark.slow
def test_many_at_a_time_come_to_the_same_figures(plates: Path, tmp_path: Path) -> None:
    heard = list[int]()
    evaluation = planned(plates, *CHEAP, "spline-gains")
    objects = evaluation.inputs.dataset.objects()
    run_objects(evaluation, objects, ResultsFolder(tmp_path / "one"))
    many = ResultsFolder(tmp_path / "many")
    listen: Progress = lambda message, done, total: heard.append(done)  # noqa: E731
    run_objects(evaluation, objects, many, workers=2, progress=listen)
    assert heard == sorted(heard)
    assert {*heard} == {0, 1, 2, 3}
    one, other = summed(tmp_path / "one"), summed(tmp_path / "many")
    for method, figures in one["methods"].items():
        assert other["methods"][method] == figures
    assert one["failures"] == other["failures"] == []
