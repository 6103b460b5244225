"""Error over the number of places: how contacts are chosen, what is drawn, and the command that does both."""

import json
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.cli.evaluate import run
from avmsf.cli.options.evaluate import parse
from avmsf.errors import AvmsfError, EvaluationError
from avmsf.evaluation.cases import Choosing, Growing
from avmsf.evaluation.objects import ObjectBodies
from avmsf.evaluation.protocols import protocol_named
from avmsf.evaluation.results import CaseRecord, ObjectRecord, Outcome
from avmsf.evaluation.runner import Evaluation
from avmsf.evaluation.summary import curves, draw_learning_curve
from factories.plate_capture import fill_plate
from factories.raising import raises

Streams = pytest.CaptureFixture[str]


def impacts_at(contacts: torch.Tensor) -> Impacts:
    count = len(contacts)
    return Impacts(contacts, torch.zeros(count, 4), 8000.0, tuple(f"{row}.wav" for row in range(count)))


def test_choices_grow_and_all_of_a_start_are_judged_alike() -> None:
    impacts = impacts_at(torch.rand(40, 3, generator=torch.Generator().manual_seed(0)))
    growing = Growing(starts=2)
    assert isinstance(growing, Choosing)
    cases = growing.cases(impacts)
    assert [case.label for case in cases[::2]] == [f"{count} places" for count in (3, 4, 6, 8, 12, 16, 24)]
    assert len({case.key for case in cases}) == 14
    for first in ("0.wav", "20.wav"):
        of_start = [case for case in cases if case.fold == f"from {first}"]
        for smaller, larger in pairwise(of_start):
            assert larger.train[: len(smaller.train)] == smaller.train
            assert larger.test == smaller.test
        assert impacts.names[of_start[0].train[0]] == first
        assert sorted(of_start[-1].train + of_start[-1].test) == list(range(40))


def test_repeated_strikes_stay_together() -> None:
    places = torch.rand(6, 3, generator=torch.Generator().manual_seed(1))
    impacts = impacts_at(places.repeat(2, 1))
    for case in Growing((2, 4), 1).cases(impacts):
        assert {row % 6 for row in case.train}.isdisjoint(row % 6 for row in case.test)
        assert len(case.train) == 2 * int(case.label.split()[0])


@pytest.mark.parametrize(
    ("growing", "count", "name", "value"), [(Growing(), 2, "contacts", 2), (Growing((3, 12)), 12, "counts", 12)]
)
def test_numbers_that_a_capture_does_not_have_are_refused(growing: Growing, count: int, name: str, value: int) -> None:
    with raises(EvaluationError, name=name, value=value):
        growing.cases(impacts_at(torch.rand(count, 3, generator=torch.Generator().manual_seed(2))))


def test_settings_that_mean_nothing_are_refused() -> None:
    with raises(EvaluationError, name="counts", value=[0, 3]):
        Growing((0, 3))
    with raises(EvaluationError, name="starts", value=0):
        Growing(starts=0)


def record_of(errors: dict[tuple[str, int, str], tuple[float | None, ...]]) -> ObjectRecord:
    keys = sorted({(count, fold) for _, count, fold in errors})
    cases = tuple(CaseRecord(f"{count} places: {fold}", f"{count} places", (), ()) for count, fold in keys)
    outcomes = tuple(
        Outcome(f"{count} places: {fold}", method, {"l1": values}) for (method, count, fold), values in errors.items()
    )
    return ObjectRecord("mug", cases=cases, outcomes=outcomes)


def test_curves_are_means_over_contacts_then_over_starts() -> None:
    record = record_of(
        {
            ("knn3", 4, "a"): (1.0, 3.0),
            ("knn3", 4, "b"): (4.0, None),
            ("knn3", 12, "a"): (0.5, 0.7),
            ("nearest", 12, "a"): (2.0, 2.0),
        }
    )
    knn, nearest = curves(record, metric="l1")
    assert (knn.method, knn.counts, knn.starts) == ("knn3", (4, 12), (2, 1))
    assert knn.mean == pytest.approx((3.0, 0.6))
    assert (knn.lowest, knn.highest) == (pytest.approx((2.0, 0.6)), pytest.approx((4.0, 0.6)))
    assert (nearest.counts, nearest.mean) == ((12,), (2.0,))
    axes = draw_learning_curve((knn, nearest), metric="l1", title="mug").axes[0]
    drawn = {str(line.get_label()): line.get_xydata() for line in axes.get_lines()}
    assert drawn["knn3"] == pytest.approx(torch.tensor([[4.0, 3.0], [12.0, 0.6]]).numpy())
    with raises(EvaluationError, name="metric", value="l2"):
        curves(record, metric="l2")


def test_a_capture_becomes_a_picture_and_figures_and_methods_may_be_added(tmp_path: Path, capsys: Streams) -> None:
    capture, results = fill_plate(tmp_path / "plate"), tmp_path / "results"
    words = ["learning-curve", str(capture), "--starts", "2", "--modes", "6", "--output", str(results)]
    counts = ["--counts", "2", "4"]
    assert run(parse([*words, *counts, "--methods", "knn3"])) == 0
    first = json.loads((results / "plate" / "learning-curve.json").read_text())
    assert list(first["methods"]) == ["knn3"]
    capsys.readouterr()
    assert run(parse([*words, *counts, "--methods", "knn3,nearest", "--json"])) == 0
    out, _ = capsys.readouterr()
    printed = json.loads(out)
    assert printed["curves"]["plate"]["knn3"] == first["methods"]["knn3"]
    assert printed["curves"]["plate"]["nearest"]["counts"] == [2, 4]
    assert printed["curves"]["plate"]["nearest"]["starts"] == [2, 2]
    assert printed["failures"] == []
    assert (results / "plate" / "learning-curve.png").read_bytes().startswith(b"\x89PNG")
    with raises(AvmsfError, file=results, name="choosing"):
        run(parse([*words, "--counts", "3", "4", "--methods", "knn3"]))


def test_a_metric_that_is_not_drawn_is_refused_before_any_work(tmp_path: Path, capsys: Streams) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(["learning-curve", str(tmp_path), "--metric", "l2"])
    assert ended.value.code == 2
    assert "l1_log" in capsys.readouterr().err


def test_the_papers_network_takes_part_and_a_known_wall_is_handed_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "field-positions" in protocol_named("learning-curve").methods
    asked: list[Evaluation] = []

    def stop(evaluation: Evaluation, *objects: object, **settings: object) -> None:
        asked.append(evaluation)
        raise KeyboardInterrupt

    monkeypatch.setattr("avmsf.cli.evaluate.run_objects", stop)
    capture = fill_plate(tmp_path / "plate")
    words = [
        "learning-curve",
        str(capture),
        "--counts",
        "2",
        "--output",
        str(tmp_path / "results"),
        "--body.wall",
        "0.004",
    ]
    assert run(parse(words)) == 130
    bodies = asked[0].bodies
    assert isinstance(bodies, ObjectBodies)
    assert bodies.config.wall == 0.004
    # Figures of another wall are not these.
    assert asked[0].settings["body"]["wall"] == 0.004
