"""Places are counted, chosen and left out with all their recordings, however often and however exactly."""

import pytest
import torch

from avmsf.capture.impacts import Impacts
from avmsf.cli.report import parts_words
from avmsf.errors import EvaluationError
from avmsf.evaluation.splits import Choosing, Closest, DistinctContacts, Farthest, LeaveOneOut, Shots, split
from factories.raising import raises

COUNT = 20


def repeated(*, apart: float = 0.0, times: int = 3) -> Impacts:
    """Return impacts on a grid of 20 places, each struck several times, `apart` diagonals from each other.

    Recordings of one place are not next to each other in the table.
    """
    grid = torch.cartesian_prod(torch.arange(5.0), torch.arange(4.0)).double()
    contacts = torch.cat([grid, torch.zeros(COUNT, 1, dtype=torch.float64)], dim=1).repeat(times, 1)
    contacts[:, 2] = 5.0 * apart * torch.arange(times, dtype=torch.float64).repeat_interleave(COUNT)
    sounds = torch.zeros(len(contacts), 4)
    return Impacts(contacts, sounds, 8000.0, tuple(f"{row:02d}.wav" for row in range(len(contacts))))


@pytest.mark.parametrize("times", [1, 2, 5])
def test_a_fraction_is_of_places(times: int) -> None:
    for fraction, places in ((0.5, 10), (0.3, 6), (0.9, 18)):
        train, test = split(repeated(times=times), fraction)
        assert (len(train), len(test)) == (places * times, (COUNT - places) * times)
        for choosing in (Farthest(fraction), Closest(fraction)):
            (case,) = choosing.cases(repeated(times=times))
            assert len(case.train) == places * times


@pytest.mark.parametrize("apart", [0.0, 0.002])
@pytest.mark.parametrize("choosing", [Farthest(), Closest(), LeaveOneOut(), Shots(), Shots((3, 2), starts=2)], ids=repr)
def test_repeats_measured_again_stay_on_one_side(choosing: Choosing, apart: float) -> None:
    impacts = repeated(apart=apart)
    found = [(case.label, case.train, case.test) for case in choosing.cases(impacts)]
    for label, train, test in found:
        assert {row % COUNT for row in train}.isdisjoint(row % COUNT for row in test)
        assert len(train) == 3 * len({row % COUNT for row in train})
        if label.split()[0].isdecimal():
            assert len(train) == 3 * int(label.split()[0])
    # The places are those that are chosen where each is struck once.
    once = [tuple(row for row in case.train) for case in choosing.cases(repeated(times=1))]
    assert [tuple(row for row in train if row < COUNT) for _, train, _ in found] == once


def test_contacts_apart_are_places_of_their_own() -> None:
    assert len(DistinctContacts.of(repeated(apart=0.02)).rows) == 3 * COUNT
    assert len(DistinctContacts.of(repeated(apart=0.002)).rows) == COUNT


def test_a_choice_may_start_from_any_recording_of_a_place() -> None:
    impacts = repeated()
    names = {row: split(impacts, 5, start=row)[0].names for row in (7, 27, 47)}
    assert names[7] == names[27] == names[47]
    assert names[7][0] == "07.wav"
    with raises(EvaluationError, name="start", value=60):
        split(impacts, 5, start=60)


def test_places_and_recordings_are_told_apart() -> None:
    assert parts_words(*split(repeated(times=1), 5)) == "15 positions not trained on, 5 trained on"
    words = parts_words(*split(repeated(apart=0.002), 5))
    assert words == "15 positions not trained on, 5 trained on (45 and 15 recordings)"
