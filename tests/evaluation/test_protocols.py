"""Training and test never mix, whatever the protocol, and each chooses what the paper says."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.registry import BASELINE, METHODS, PROTOCOLS, protocol_named
from avmsf.evaluation.splits import Closest, Farthest, FewerViews, LeaveOneOut, Predefined, Shots, split
from factories.plate_field import plate_impacts
from factories.raising import raises


def struck(count: int = 20, *, repeated: tuple[int, ...] = ()) -> Impacts:
    """Return impacts on a plate, some contacts of which are struck once more at the end."""
    impacts = plate_impacts(count, seconds=0.02)
    rows = [*range(count), *repeated]
    return replace(impacts.take(rows), names=tuple(f"{number:02d}" for number in range(len(rows))))


def places(impacts: Impacts, rows: tuple[int, ...]) -> set[tuple[float, ...]]:
    return {tuple(contact) for contact in impacts.contacts[list(rows)].tolist()}


@pytest.mark.parametrize("repeated", [(), (0, 5, 5, 11)])
@pytest.mark.parametrize("name", PROTOCOLS)
def test_training_and_test_contacts_never_mix(name: str, repeated: tuple[int, ...]) -> None:
    impacts = struck(repeated=repeated)
    choosing = Predefined(("03", "05", "19")) if name == "predefined" else PROTOCOLS[name].choosing
    cases = choosing.cases(impacts)
    assert len({case.key for case in cases}) == len(cases) > 0
    for case in cases:
        assert case.train
        assert case.test
        assert len(set(case.train)) == len(case.train)
        assert list(case.test) == sorted(set(case.test))
        assert not places(impacts, case.train) & places(impacts, case.test)


@pytest.mark.parametrize("repeated", [(), (0, 5, 5, 11)])
def test_farthest_is_the_split_that_all_other_commands_make(repeated: tuple[int, ...]) -> None:
    impacts = struck(repeated=repeated)
    (case,) = Farthest().cases(impacts)
    train, test = split(impacts, 0.2)
    assert impacts.take(case.train).names == train.names
    assert impacts.take(case.test).names == test.names


def test_closest_takes_the_ball_around_the_first_contact() -> None:
    impacts = struck()
    (case,) = Closest(0.3).cases(impacts)
    distance = (impacts.contacts - impacts.contacts[0]).norm(dim=1)
    assert case.train[0] == 0
    assert len(case.train) == 6
    assert float(distance[list(case.train)].max()) < float(distance[list(case.test)].min())


def test_leave_one_out_tests_every_impact_once() -> None:
    impacts = struck(6, repeated=(2,))
    cases = LeaveOneOut().cases(impacts)
    assert len(cases) == 6
    assert sorted(row for case in cases for row in case.test) == list(range(7))
    assert cases[2].test == (2, 6)
    assert all(len(case.train) + len(case.test) == 7 for case in cases)
    assert {case.label for case in cases} == {"leave-one-out"}


def test_a_predefined_split_tests_the_named_recordings_and_trains_on_all_at_other_contacts() -> None:
    impacts = struck(6, repeated=(2, 4))
    (case,) = Predefined(("02", "05")).cases(impacts)
    assert [impacts.names[row] for row in case.test] == ["02", "05"]
    # 06 is at the contact of 02.
    assert {impacts.names[row] for row in case.train} == {"00", "01", "03", "04", "07"}


@pytest.mark.parametrize(("test", "name", "value"), [((), "count", 6), (("02", "99"), "test", "99")])
def test_a_predefined_split_needs_names_of_recordings(test: tuple[str, ...], name: str, value: object) -> None:
    with raises(EvaluationError, name=name, value=value):
        Predefined(test).cases(struck(6))


def test_shots_are_nested_and_judged_by_the_same_contacts() -> None:
    cases = Shots().cases(struck(20))
    assert [case.label for case in cases] == ["16 shots", "8 shots", "4 shots", "2 shots", "1 shot"]
    assert [len(case.train) for case in cases] == [16, 8, 4, 2, 1]
    for more, fewer in pairwise(cases):
        assert more.train[: len(fewer.train)] == fewer.train
    assert len({case.test for case in cases}) == 1
    assert set(cases[0].test) == set(range(20)) - set(cases[0].train)


def test_shots_that_an_object_has_no_contacts_for_are_left_out() -> None:
    assert [case.label for case in Shots().cases(struck(5))] == ["4 shots", "2 shots", "1 shot"]


def test_shots_from_several_starts_have_test_contacts_of_their_own() -> None:
    impacts = struck(20)
    cases = Shots((6, 3), starts=2).cases(impacts)
    assert len({case.key for case in cases}) == 4
    for first, own in ((0, cases[:2]), (10, cases[2:])):
        assert {case.fold for case in own} == {f"from {impacts.names[first]}"}
        assert own[0].train[0] == own[1].train[0] == first
        assert own[0].test == own[1].test == tuple(sorted(set(range(20)) - set(own[0].train)))


@pytest.mark.parametrize(
    ("settings", "name", "value"), [({"counts": (0, 3)}, "counts", [0, 3]), ({"starts": 0}, "starts", 0)]
)
def test_shots_that_mean_nothing_are_refused(settings: dict[str, Any], name: str, value: object) -> None:
    with raises(EvaluationError, name=name, value=value):
        Shots(**settings)


def test_fewer_views_change_nothing_but_the_views() -> None:
    every, few = FewerViews().cases(struck())
    assert (every.views, few.views) == (None, 12)
    assert (every.train, every.test) == (few.train, few.test)
    assert replace(few, label="farthest", views=None) == Farthest().cases(struck())[0]


def test_too_few_contacts_are_refused() -> None:
    lonely = replace(struck(3), contacts=torch.zeros(3, 3, dtype=torch.float64))
    for choosing in (Farthest(), Closest(), LeaveOneOut(), Shots()):
        with raises(EvaluationError, name="count") as caught:
            choosing.cases(lonely)
        assert "3 recordings at 1 contact" in str(caught.value)


def test_all_methods_of_all_protocols_are_known_and_the_baseline_takes_part() -> None:
    for protocol in PROTOCOLS.values():
        assert set(protocol.methods) <= set(METHODS)
        # A mean waveform does not locate anything.
        assert (BASELINE in protocol.methods) != protocol.locating


def test_an_unknown_protocol_lists_the_known_ones() -> None:
    with raises(EvaluationError, name="protocol", value="farhest") as caught:
        protocol_named("farhest")
    assert all(name in str(caught.value) for name in PROTOCOLS)
    assert str(caught.value).endswith("did you mean farthest?")
