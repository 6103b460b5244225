"""Labels that were exchanged and directions that were turned round, on the dome of the tests of bodies."""

import math
from dataclasses import replace

import pytest
import torch

from avmsf.field.bodychoice import ChosenBody, MeasuredGains, likely_bodies, plausible_bodies
from avmsf.field.suspects import Suspect, agreeing, doubted, find_suspects
from made_dome import WALLS, bodies, points, struck

SEEDS = (1, pytest.param(0, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow))
NAMES = tuple(f"strike {row}" for row in range(15))


def likely(measured: MeasuredGains) -> tuple[ChosenBody, ...]:
    return likely_bodies(bodies(), points(), measured)


def plausible(measured: MeasuredGains) -> tuple[ChosenBody, ...]:
    return plausible_bodies(bodies(), points(), measured)


def exchanged(measured: MeasuredGains, *, seed: int) -> tuple[MeasuredGains, list[int]]:
    """Return the gains with three strikes' labels in a circle, and which."""
    order = torch.randperm(len(measured.contacts), generator=torch.Generator().manual_seed(100 + seed))
    rows, others = order[:3], order[:3].roll(1)
    contacts, directions = measured.contacts.clone(), measured.directions.clone()
    contacts[rows], directions[rows] = measured.contacts[others], measured.directions[others]
    return replace(measured, contacts=contacts, directions=directions), sorted(rows.tolist())


@pytest.mark.parametrize("seed", SEEDS)
def test_a_clean_set_names_none(seed: int):
    measured = struck(WALLS[1], 15, seed=seed)
    assert find_suspects(plausible(measured), measured) == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_of_three_labels_that_changed_places_those_that_went_far_are_named_and_no_others(seed: int):
    """A label a sixth of the dome's size away is wrong; one that is a few centimetres off foretells much as it is."""
    clean = struck(WALLS[1], 15, seed=seed)
    measured, rows = exchanged(clean, seed=seed)
    found = find_suspects(plausible(measured), measured)
    away = (clean.contacts - measured.contacts).norm(dim=1)
    named = {each.row for each in found}
    assert named <= set(rows)
    assert named >= {row for row in rows if float(away[row]) > 0.055}
    assert len(named) >= 2
    assert [each.misfit for each in found] == sorted((each.misfit for each in found), reverse=True)
    # Where it was really struck is found between places some 2 cm apart.
    for each in found:
        assert each.distance == pytest.approx(float(away[each.row]), abs=0.015)
        assert each.place == pytest.approx(clean.contacts[each.row].tolist(), abs=0.015)
    assert agreeing(likely(measured), doubted(measured, found)).name == bodies()[1].name


@pytest.mark.parametrize("row", [2, pytest.param(9, marks=pytest.mark.slow)])
def test_a_direction_turned_round_is_found_as_such(row: int):
    measured = struck(WALLS[1], 15, seed=1)
    directions = measured.directions.clone()
    directions[row] *= -1
    measured = replace(measured, directions=directions)
    (found,) = find_suspects(plausible(measured), measured)
    assert found.row == row
    assert found.reversed
    assert found.distance < 0.02
    # Twice as far off as silence: four times its square.
    assert found.misfit == pytest.approx(4.0, rel=0.3)
    assert found.best < 0.2


@pytest.mark.parametrize(
    ("seed", "row", "axis"),
    [
        (0, 0, 1),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((1, 4, 0), (1, 8, 0), (2, 4, 0), (3, 0, 0))),
    ],
)
def test_a_label_on_the_other_side_is_found_though_half_of_the_modes_are_as_strong_there(
    seed: int, row: int, axis: int
):
    measured = struck(WALLS[1], 12, seed=seed)
    contacts, directions = measured.contacts.clone(), measured.directions.clone()
    contacts[row, axis] *= -1
    directions[row, axis] *= -1
    (found,) = find_suspects(plausible(measured), replace(measured, contacts=contacts, directions=directions))
    assert found.row == row
    assert found.is_elsewhere
    assert found.distance == pytest.approx(2.0 * abs(float(contacts[row, axis])), abs=0.015)


def test_where_no_directions_were_given_none_is_reversed():
    measured = struck(WALLS[1], 15, seed=1)
    values = measured.values.clone()
    values[2] *= -1
    (known,) = find_suspects(plausible(measured), replace(measured, values=values))
    (unknown,) = find_suspects(plausible(measured), replace(measured, values=values, directions=None))
    assert known.row == unknown.row == 2
    assert known.reversed
    assert not unknown.reversed


def test_too_few_strikes_accuse_none():
    measured = struck(WALLS[1], 5)
    directions = measured.directions.clone()
    directions[1] *= -1
    measured = replace(measured, directions=directions)
    assert find_suspects(plausible(measured), measured) == ()


def test_suspects_count_for_nothing():
    measured = struck(WALLS[1], 12)
    silent = doubted(measured, [Suspect(4, 2.0, 0.1, False, 0.1, 0.3, (0.0, 0.0, 0.0))])
    wild = replace(silent, values=torch.where((torch.arange(12) == 4)[:, None, None], -silent.values, silent.values))
    body = likely(measured)[0]
    one, other = (body.fit(each).at(points()[:50]).mean for each in (silent, wild))
    assert float((one - other).abs().max()) < 1e-3 * float(one.abs().max())
    assert silent.doubt[4] > 1e5
    assert silent.doubt.sum() - silent.doubt[4] == 11


def test_a_strike_without_any_sound_is_named_as_silent():
    measured = struck(WALLS[1], 12)
    values = measured.values.clone()
    values[5] = 0.0
    measured = replace(measured, values=values)
    found = find_suspects(plausible(measured), measured)
    assert [each.describe(NAMES, measured.contacts) for each in found] == ["strike 5 is silent"]


AT = torch.tensor([[0.0, 0, 0.1 * row] for row in range(15)])
BY_ONE = (0.0, 0.001, 0.5)


@pytest.mark.parametrize(
    ("suspect", "words"),
    [
        (
            Suspect(3, 2.1, 0.2, False, 0.1, 1.0, BY_ONE),
            "strike 3 fits best 0.2 m away, at (0, 0.001, 0.5) m, near to where strike 5 is said to be (misfit 2.1 "
            "where it is said to be, 0.1 there; 0 is",
        ),
        (Suspect(3, 2.1, 0.2, False, 0.1, 0.01, BY_ONE), "strike 3 fits best 0.2 m away, at (0, 0.001, 0.5) m (misfit"),
        (Suspect(5, 2.1, 0.2, False, 0.1, 1.0, BY_ONE), "strike 5 fits best 0.2 m away, at (0, 0.001, 0.5) m (misfit"),
        (Suspect(3, 4.0, 0.0, True, 0.1, 1.0, BY_ONE), "strike 3 fits best with its direction reversed (misfit 4"),
        (
            Suspect(3, 4.0, 0.05, True, 0.1, 0.01, (1.0, 0.0, 0.0)),
            "strike 3 fits best 0.05 m away, at (1, 0, 0) m with its direction reversed (misfit 4",
        ),
        (
            Suspect(3, 1.2, 0.3, False, 0.9, 1.0, BY_ONE),
            "strike 3 fits nowhere on the object (misfit 1.2 where it is said to be, 0.9 at best;",
        ),
        (Suspect(3, 0.5, 0.0, False, 0.5, 1.0, BY_ONE), "strike 3 fits its place badly"),
    ],
)
def test_suspects_say_what_is_wrong_with_them(suspect: Suspect, words: str):
    assert suspect.describe(NAMES, AT).startswith(words)
    assert math.isfinite(suspect.misfit)
