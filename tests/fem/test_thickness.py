"""The thickness of a wall by the evidence of gains."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from avmsf.fem.candidate_bodies import CandidateBody
from avmsf.fem.material import DISCREPANCY, MATERIALS, NOMINAL, factor_range
from avmsf.fem.thickness import ThicknessPosterior, search_thickness
from factories.made_dome import bodies

GRID = (0.001, 0.0016, 0.0025, 0.004, 0.0063)
"""Meters; None is the filled body."""


def searched(
    of: Callable[[float], float], *, filled: float = -1000.0, walls: Sequence[float | None] = GRID, made: bool = True
) -> tuple[Sequence[CandidateBody], ThicknessPosterior | None, list[float]]:
    """Search by the evidence of a log thickness and of the filled body; return the walls that were asked for, too."""
    asked: list[float] = []

    def walled(wall: float | None) -> CandidateBody:
        return replace(bodies()[0], thickness=wall)

    def evidence(known: Sequence[CandidateBody]) -> list[float]:
        return [filled if body.thickness is None else of(math.log(body.thickness)) for body in known]

    def make(like: CandidateBody, wall: float) -> CandidateBody | None:
        asked.append(wall)
        return walled(wall) if made else None

    return *search_thickness([walled(each) for each in walls], evidence, make), asked


def normal(true: float, deviation: float) -> Callable[[float], float]:
    return lambda log: -0.5 * ((log - math.log(true)) / deviation) ** 2


@pytest.mark.parametrize(
    ("true", "deviation"),
    # The last is thinner than all walls given.
    [(0.0029, 0.07), (0.0029, 0.2), (0.0018, 0.1), (0.55 * GRID[0], 0.1)],
)
def test_the_posterior_of_a_normal_evidence_is_normal_with_the_variance_of_shapes_added(
    true: float, deviation: float
) -> None:
    found, thickness, _ = searched(normal(true, deviation), walls=(None, *GRID))
    assert thickness.median == pytest.approx(true, rel=0.03)
    both = math.hypot(deviation, 0.2)
    assert math.log(thickness.high / thickness.low) == pytest.approx(2 * 1.645 * both, rel=0.15)
    assert all(body.thickness is not None for body in found)
    assert min(abs(math.log(body.thickness / true)) for body in found if body.thickness) < 0.04


def test_a_maximum_between_distant_walls_is_found() -> None:
    # As of a dish from photographs: gently up to 4.2 mm, then steeply down.
    steps = np.log([0.000625, 0.0014, 0.00306, 0.0036, 0.0042, 0.005, 0.006, 0.0068, 0.015])
    table = [-81.0, -60.0, -9.0, -4.0, 0.0, -6.0, -49.0, -73.0, -240.0]
    walls = (None, 0.000625, 0.001383, 0.003061, 0.006775, 0.014997)
    found, _, _ = searched(lambda log: float(np.interp(log, steps, table)), filled=-148.0, walls=walls)
    assert found[0].thickness == pytest.approx(0.0042, rel=0.08)


def test_neither_thicker_walls_than_the_views_allow_are_tried_nor_ever_thinner_ones() -> None:
    _, thickness, asked = searched(lambda log: 20.0 * log)
    assert max(asked) < GRID[-1] == pytest.approx(thickness.median, rel=0.1)
    _, _, asked = searched(lambda log: -20.0 * log)
    assert GRID[0] / 4 <= min(asked) < GRID[0]


def test_no_thickness_is_looked_for_where_the_filled_body_is_the_most_probable() -> None:
    found, thickness, asked = searched(lambda log: 0.0, filled=10.0, walls=(None, *GRID))
    assert (thickness, asked) == (None, [])
    assert [body.thickness for body in found] == [None]


def test_of_open_and_closed_walls_those_like_the_most_probable_one_are_searched() -> None:
    asked: list[bool] = []

    def make(like: CandidateBody, wall: float) -> CandidateBody:
        asked.append(like.closed)
        return replace(like, thickness=wall)

    def evidence(known: Sequence[CandidateBody]) -> list[float]:
        true = {False: 0.0011, True: 0.0029}
        return [normal(true[body.closed], 0.2)(math.log(body.thickness)) - 20.0 * (not body.closed) for body in known]

    both = [replace(bodies()[0], thickness=wall, closed=closed) for closed in (False, True) for wall in GRID]
    found, thickness = search_thickness(both, evidence, make)
    assert thickness.median == pytest.approx(0.0029, rel=0.03)
    assert asked
    assert all(asked)
    assert all(body.closed for body in found)


def test_the_right_wall_of_every_material_is_within_the_range_of_factors() -> None:
    speeds = [math.sqrt(each.young / each.density * NOMINAL.density / NOMINAL.young) for each in MATERIALS.values()]
    low, high = factor_range()
    # A bending wall that is taken to be thinner by a part needs frequencies higher by as much.
    assert max(speeds) * (1.0 + DISCREPANCY) < high < max(speeds) * 1.3
    assert min(speeds) / (1.0 + DISCREPANCY) > low > min(speeds) / 1.3


def test_other_thicknesses_are_tried_where_a_body_cannot_be_had() -> None:
    _, thickness, asked = searched(lambda log: -((log - math.log(0.0029)) ** 2), made=False)
    assert len({round(each, 9) for each in asked}) == len(asked) > 1
    assert thickness.low < 0.0029 < thickness.high
