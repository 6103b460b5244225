"""Methods learn from, and are compared with, recordings that all start at one time after their impacts."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from avmsf.capture.folder import Capture
from avmsf.capture.impacts import Impacts
from avmsf.datasets.dataset import ObjectFacts
from avmsf.errors import EvaluationError
from avmsf.evaluation import align_split, evaluate
from avmsf.evaluation.case_run import CaseRun, Evaluation, ObjectData
from avmsf.evaluation.field_methods import FieldMethod
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.registry import PROTOCOLS
from avmsf.evaluation.scores import MetricSettings
from avmsf.evaluation.simple_methods import NearestRecording
from avmsf.evaluation.splits import Case
from avmsf.evaluation.task import Task
from factories.delayed_plate import ALIGNED, delays, distance, strikes, without_delays
from factories.plate_set import PlateInputs
from factories.raising import raises

COUNT, TRAIN = 16, 12
METHODS = ("nearest", "knn3", "knn-gains")


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
    evaluation = Evaluation(
        Plate(impacts),
        "plates",
        PROTOCOLS["farthest"],
        tuple(map(method_named, METHODS)),
        PlateInputs(),
        metric_settings=MetricSettings(level="raw", cdpam=False),
        own_starts=None if own_starts is None else Plate(own_starts),
    )
    case = Case("all", tuple(range(TRAIN)), tuple(range(TRAIN, COUNT)))
    return CaseRun(evaluation, ObjectData(evaluation, "a"), case, folder=folder, number=1, stores_sounds=False)


def test_errors_of_baselines_do_not_depend_on_delays(tmp_path: Path) -> None:
    starts = delays(COUNT)
    run = run_of(strikes(COUNT, starts=starts), tmp_path / "delayed")
    found = [run.outcome(method) for method in run.evaluation.methods]
    same = without_delays(run.data.impacts, run.scored.modes(), starts)
    other = run_of(same, tmp_path / "exact")
    expected = [other.outcome(method) for method in run.evaluation.methods]
    assert distance(run.scored.train.sounds, other.scored.train.sounds) < ALIGNED
    assert distance(run.scored.test.sounds, other.scored.test.sounds) < ALIGNED
    for one, other_one in zip(found, expected, strict=True):
        assert one.failure is None
        for metric in ("relative_stft", "l1", "envelope"):
            assert one.values[metric] == pytest.approx(other_one.values[metric], rel=2 * ALIGNED), (one.method, metric)


class NearestThree:
    """The built-in knn3 as somebody else would write it."""

    def __init__(self, train: Impacts) -> None:
        self.train, self.sample_rate = train, train.sample_rate

    def render(self, contacts: Tensor, *, directions: Tensor | None = None) -> Tensor:
        nearest = torch.cdist(contacts, self.train.contacts).argsort(1)[:, :3]
        return self.train.sounds[nearest].mean(1)


def test_an_own_method_in_python_gets_the_score_of_the_same_built_in_one(tmp_path: Path) -> None:
    run = run_of(strikes(COUNT, starts=delays(COUNT)), tmp_path)
    train, test = run.scored.train, run.scored.test
    built_in = run.outcome(method_named("knn3"))
    own = evaluate(NearestThree, test, train=train)
    aligned = align_split(train, test)
    by_hand = evaluate(NearestThree(aligned[0]), aligned[1])
    for metric, values in own.values.items():
        assert values.tolist() == pytest.approx(built_in.values[metric], rel=1e-6), metric
        assert by_hand.values[metric].tolist() == pytest.approx(values.tolist(), rel=1e-6), metric
    # What this is for: recordings as they are give another score.
    assert evaluate(NearestThree(train), test).mean()["relative_stft"] > 1.02 * own.mean()["relative_stft"]


def test_fields_are_fitted_to_own_starts_and_all_are_scored_from_the_peaks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = strikes(COUNT, starts=delays(COUNT))
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


def test_sounds_of_another_rate_than_the_recordings_are_not_scored() -> None:
    impacts = strikes(4, starts=delays(4))
    renderer, other = NearestRecording(impacts), replace(impacts, sample_rate=2 * impacts.sample_rate)
    with raises(EvaluationError, name="sample_rate", value=impacts.sample_rate):
        MetricSettings(cdpam=False).values(renderer, impacts.sounds, other, None, loudest=1.0)
