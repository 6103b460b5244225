"""Plans, registries and splits of evaluations."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch

from avmsf.capture import read_capture
from avmsf.capture.impacts import Impacts
from avmsf.datasets import CaptureCollection
from avmsf.errors import EvaluationError, SceneError
from avmsf.evaluation.methods import method_named
from avmsf.evaluation.plan import Evaluation, available_encoders, visual_inputs
from avmsf.evaluation.registry import BASELINE, METHODS, METRICS, PROTOCOLS, MetricEntry, MetricSettings, VisualInput
from avmsf.evaluation.results import ResultsFolder
from avmsf.evaluation.scores import score
from avmsf.evaluation.simple_methods import MeanWaveform
from avmsf.evaluation.splits import (
    Case,
    align_split,
    closest,
    farthest,
    fewer_views,
    leave_one_out,
    predefined,
    shots,
    split,
)
from avmsf.features.encoder import Encoder, ImageDescriptors
from avmsf.mesh.points import farthest_points
from avmsf.pipeline.config import DESCRIPTORS, DINO, PRESETS, LiftConfig
from avmsf.pipeline.features import DinoEncoder
from factories.plate_field import plate_impacts
from factories.plate_set import PlateInputs, fill_plates
from factories.raising import raises

COUNT = 20


def struck(count: int = COUNT, *, repeated: tuple[int, ...] = ()) -> Impacts:
    """Return impacts on a plate, some contacts of which are struck once more at the end."""
    impacts = plate_impacts(count, seconds=0.02)
    rows = [*range(count), *repeated]
    return replace(impacts.take(rows), names=tuple(f"{number:02d}" for number in range(len(rows))))


def grid(*, apart: float = 0.0, times: int = 3) -> Impacts:
    """Return impacts on a grid of 20 contacts, each struck several times, `apart` diagonals from each other.

    Recordings of one contact are not next to each other in the table.
    """
    points = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0)).double()
    contacts = torch.cat([points, torch.zeros(COUNT, 1, dtype=torch.float64)], dim=1).repeat(times, 1)
    contacts[:, 2] = 5.0 * apart * torch.arange(times, dtype=torch.float64).repeat_interleave(COUNT)
    sounds = torch.zeros(len(contacts), 4)
    return Impacts(contacts, sounds, 8000.0, tuple(f"{row:02d}.wav" for row in range(len(contacts))))


@pytest.mark.parametrize("repeated", [(), (0, 5, 5, 11)])
@pytest.mark.parametrize("name", [name for name, each in PROTOCOLS.items() if each.scoring != "edits"])
def test_training_and_test_contacts_never_mix(name: str, repeated: tuple[int, ...]) -> None:
    impacts = struck(repeated=repeated)
    settings = {"test": ("03", "05", "19")} if name == "predefined" else {}
    cases = replace(PROTOCOLS[name], settings=settings).split(impacts)
    assert len({case.key for case in cases}) == len(cases) > 0
    for case in cases:
        assert case.train
        assert case.test
        assert len(set(case.train)) == len(case.train)
        assert list(case.test) == sorted(set(case.test))
        train, test = (set(map(tuple, impacts.contacts[list(rows)].tolist())) for rows in (case.train, case.test))
        assert not train & test


@pytest.mark.parametrize("apart", [0.0, 0.002])
@pytest.mark.parametrize("cases_of", [farthest, closest, leave_one_out, shots, partial(shots, counts=(3, 2), starts=2)])
def test_recordings_of_one_contact_stay_on_one_side(
    cases_of: Callable[[Impacts], tuple[Case, ...]], apart: float
) -> None:
    cases = cases_of(grid(apart=apart))
    for case in cases:
        assert {row % COUNT for row in case.train}.isdisjoint(row % COUNT for row in case.test)
        contacts = len({row % COUNT for row in case.train})
        assert len(case.train) == 3 * contacts
        if case.label.split()[0].isdecimal():
            assert contacts == int(case.label.split()[0])
    # The contacts are those that are chosen where each is struck once.
    once = [case.train for case in cases_of(grid(times=1))]
    assert [tuple(row for row in case.train if row < COUNT) for case in cases] == once


def test_a_split_trains_on_farthest_points_and_tests_on_the_rest() -> None:
    impacts = struck(30)
    train, test = split(impacts, 0.2, start=3)
    assert train.names == tuple(impacts.names[row] for row in farthest_points(impacts.contacts, 6, start=3).tolist())
    assert list(test.names) == sorted(set(impacts.names) - set(train.names))
    assert torch.equal(train.sounds[0], impacts.sounds[3])
    assert split(impacts, 5, start=3)[0].names == train.names[:5]
    assert len(split(struck(4), 0.2)[0]) == 2
    # Any recording of a contact may be the first.
    starts = [split(grid(), 5, start=row)[0].names for row in (7, 27, 47)]
    assert starts[0] == starts[1] == starts[2]
    assert starts[0][0] == "07.wav"


def test_farthest_is_the_split_that_all_other_commands_make() -> None:
    impacts = struck(repeated=(0, 5, 5, 11))
    (case,) = farthest(impacts)
    assert [impacts.take(rows).names for rows in (case.train, case.test)] == [
        each.names for each in split(impacts, 0.2)
    ]


def test_closest_takes_the_ball_around_the_first_contact() -> None:
    impacts = struck()
    (case,) = closest(impacts, 0.3)
    distance = (impacts.contacts - impacts.contacts[0]).norm(dim=1)
    assert case.train[0] == 0
    assert len(case.train) == 6
    assert float(distance[list(case.train)].max()) < float(distance[list(case.test)].min())


def test_leave_one_out_tests_every_impact_once() -> None:
    cases = leave_one_out(struck(6, repeated=(2,)))
    assert sorted(row for case in cases for row in case.test) == list(range(7))
    assert cases[2].test == (2, 6)
    assert all(len(case.train) + len(case.test) == 7 for case in cases)
    assert {case.label for case in cases} == {"leave-one-out"}


def test_a_predefined_split_tests_the_named_recordings_and_trains_on_all_at_other_contacts() -> None:
    impacts = struck(6, repeated=(2, 4))
    (case,) = predefined(impacts, ("02", "05"))
    assert [impacts.names[row] for row in case.test] == ["02", "05"]
    # 06 is at the contact of 02.
    assert {impacts.names[row] for row in case.train} == {"00", "01", "03", "04", "07"}


def test_shots_are_nested_and_scored_at_the_same_contacts() -> None:
    cases = shots(struck())
    assert [case.label for case in cases] == ["16 shots", "8 shots", "4 shots", "2 shots", "1 shot"]
    assert [len(case.train) for case in cases] == [16, 8, 4, 2, 1]
    for more, fewer in pairwise(cases):
        assert more.train[: len(fewer.train)] == fewer.train
    assert {case.test for case in cases} == {tuple(sorted(set(range(COUNT)) - set(cases[0].train)))}
    assert [case.label for case in shots(struck(5))] == ["4 shots", "2 shots", "1 shot"]
    assert [case.label for case in shots(struck(5), (2, 2))] == ["2 shots"]
    assert len(shots(struck(6), (1,), starts=12)) == 6


def test_shots_from_several_starts_have_test_contacts_of_their_own() -> None:
    impacts = struck()
    cases = shots(impacts, (6, 3), starts=2)
    assert len({case.key for case in cases}) == 4
    for first, own in ((0, cases[:2]), (10, cases[2:])):
        assert {case.fold for case in own} == {f"from {impacts.names[first]}"}
        assert own[0].train[0] == own[1].train[0] == first
        assert own[0].test == own[1].test == tuple(sorted(set(range(COUNT)) - set(own[0].train)))


def test_fewer_views_change_nothing_but_the_views() -> None:
    every, few = fewer_views(struck())
    assert (every.views, few.views) == (None, 12)
    assert replace(few, label="farthest", views=None) == replace(every, label="farthest") == farthest(struck())[0]


LONELY = replace(struck(3), contacts=torch.zeros(3, 3, dtype=torch.float64))
REFUSED: dict[str, tuple[Callable[[], Any], str, Any]] = {
    "all contacts": (lambda: split(struck(10), 10), "count", 10),
    "no contact": (lambda: split(struck(10), 0), "train_size", 0),
    "a part of two contacts": (lambda: split(struck(10).take([0, 1, 0, 1, 0, 1]), 0.2), "count", 2),
    "more than all": (lambda: split(struck(10), 1.5), "train_size", 1.5),
    "a start that is not there": (lambda: split(struck(10), 0.2, start=10), "start", 10),
    "no predefined test": (lambda: predefined(struck(6)), "count", 6),
    "an unknown test": (lambda: predefined(struck(6), ("02", "99")), "test", "99"),
    "farthest of one contact": (lambda: farthest(LONELY), "count", 2),
    "closest of one contact": (lambda: closest(LONELY), "count", 2),
    "one contact left out": (lambda: leave_one_out(LONELY), "count", 0),
    "shots of one contact": (lambda: shots(LONELY), "count", 1),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_split_is_refused(what: str) -> None:
    call, name, value = REFUSED[what]
    with raises(EvaluationError, name=name, value=value):
        call()


def test_all_methods_of_all_protocols_are_known_and_the_baseline_takes_part() -> None:
    for protocol in PROTOCOLS.values():
        assert set(protocol.methods) <= set(METHODS)
        # A mean waveform does not locate anything.
        assert (BASELINE in protocol.methods) != (protocol.scoring != "sounds")


@pytest.mark.parametrize(
    ("name", "damping"),
    [("av-msf", "validated"), ("paper", "shared"), ("paper-grid", "shared"), ("paper-per-contact", "per-contact")],
)
def test_the_papers_method_is_the_preset_with_one_damping(name: str, damping: Any) -> None:
    field: Any = method_named(name)
    preset = PRESETS["paper"]
    assert field.pipeline == replace(preset, fit=replace(preset.fit, damping=damping))
    assert (field.pipeline == preset) == (name == "av-msf")
    assert (field.visual_input, field.published) == (VisualInput("paper"), True)


def test_an_encoder_that_is_not_there_is_refused_by_the_paper_and_said_elsewhere(monkeypatch):
    def missing(*_: Any, **__: Any) -> DinoEncoder:
        raise SceneError("facebook/dinov2-base: no weights", value="facebook/dinov2-base")

    monkeypatch.setattr(DinoEncoder, "load", missing)
    said = list[str]()
    with raises(SceneError, value="facebook/dinov2-base"):
        available_encoders(LiftConfig(), {VisualInput("visual"), VisualInput("paper")}, log=said.append)
    usual, paper = available_encoders(LiftConfig(), {VisualInput("visual")}, log=said.append)
    assert (usual.encoder, paper.encoder) == (DESCRIPTORS, DINO)
    assert any("descriptors" in line for line in said)
    named = available_encoders(LiftConfig(encoder=DESCRIPTORS), {VisualInput("paper")}, log=said.append)
    assert [each.encoder for each in named] == [DESCRIPTORS, DESCRIPTORS]
    assert named[1].onto == "gaussians"


def test_encoders_are_loaded_once_on_the_device_and_only_for_who_reads_them(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded, said = [], list[str]()

    def load(name: str, *, device: torch.device, **_: Any) -> Encoder:
        loaded.append((name, device.type))
        return ImageDescriptors()

    monkeypatch.setattr(DinoEncoder, "load", load)

    def read_by(protocol: str, *names: str) -> frozenset[Any]:
        return visual_inputs([method_named(name) for name in names], PROTOCOLS[protocol])

    read = read_by("farthest", "knn3", "white-noise", "diffsound")
    assert available_encoders(LiftConfig(), read, device="cpu", log=said.append)[0] == LiftConfig()
    # Recordings are located at the points that features have.
    assert read_by("localize", "nearest") == read_by("localize", "field-auto") == {VisualInput()}
    assert available_encoders(LiftConfig(), {VisualInput()}, log=said.append)[0] == LiftConfig()
    assert loaded == []
    read = read_by("farthest", "field", "field-auto", "paper-grid")
    assert read == {VisualInput(each) for each in ("visual", "surface", "paper")}
    assert available_encoders(LiftConfig(), read, device="cpu", log=said.append)[0].encoder == DINO
    assert loaded == [(DINO, "cpu")]


def test_methods_without_features_share_results_with_any_encoder(tmp_path: Path) -> None:
    def begin(name: str, encoder: str | None) -> None:
        methods, settings = (method_named(name),), MetricSettings(cdpam=False)
        evaluation = Evaluation(
            "plates", PROTOCOLS["farthest"], methods, PlateInputs(CaptureCollection(tmp_path), tmp_path), settings,
            encoder=encoder,
        )  # fmt: skip
        evaluation.begin(ResultsFolder(tmp_path / "results"))

    begin("knn3", None)
    begin("field", DESCRIPTORS)
    begin("knn3", DESCRIPTORS)
    with raises(EvaluationError, name="methods.field.encoder", value=DESCRIPTORS):
        begin("field", DINO)


TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorials" / "evaluate.md"


def test_a_method_and_a_metric_of_the_tutorial_are_in_the_tables(tmp_path, monkeypatch):
    fill_plates(tmp_path / "objects", ("mug",))
    monkeypatch.chdir(tmp_path)
    (block,) = (
        block for block in re.findall(r"```python\n(.*?)```", TUTORIAL.read_text(), re.DOTALL) if "METHODS[" in block
    )
    with patch.dict(METHODS), patch.dict(METRICS):
        exec(block, {})
    report = (tmp_path / "mean-of-all" / "report.md").read_text()
    assert "| peak error, dB |" in report
    assert "mean-of-all: mean waveform of all training recordings" in report
    summary = json.loads((tmp_path / "mean-of-all" / "summary.json").read_text())
    train, test = align_split(*split(read_capture(tmp_path / "objects" / "mug").impacts, 0.2))
    ratio = MeanWaveform(train, len(train)).render(test.contacts).abs().amax(1) / test.sounds.abs().amax(1)
    expected = float((20 * ratio.log10().abs()).mean())
    assert summary["methods"]["mean-of-all"]["peak_error"] == pytest.approx(expected, rel=1e-3)
    assert summary["ratio_to_knn3"]["mean-of-all"]["peak_error"] > 0


def test_a_metric_has_a_value_for_each_contact(tmp_path: Path) -> None:
    impacts = read_capture(fill_plates(tmp_path, ("mug",)) / "mug").impacts
    entry = MetricEntry("mean", lambda predicted, truth, *, sample_rate: predicted.mean())
    with patch.dict(METRICS, mean=entry), raises(EvaluationError, name="mean", value=[]):
        score(impacts.sounds, impacts)
