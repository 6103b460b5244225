"""Which wall lies behind a dome, and how stiff it is, from the gains of a few blows."""

import itertools
import math
from dataclasses import replace

import pytest
import torch

from avmsf.field.bodychoice import likely_bodies
from avmsf.field.evidence import Regression
from avmsf.field.suspects import agreeing
from avmsf.simulate.nominal import NominalBody
from made_dome import STIFFER, WALLS, bodies, points, struck


@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("count", [6, pytest.param(12, marks=pytest.mark.slow)])
def test_the_wall_and_the_stiffness_are_found_among_candidates(wall: float, count: int):
    measured = struck(wall, count)
    found = likely_bodies(bodies(), points(), measured)
    name = next(body.name for body in bodies() if body.wall == wall)
    assert found[0].name == name
    chosen = agreeing(found, measured)
    assert chosen.name == name
    # Factors are tried a twentieth apart; coarse elements are a little too stiff.
    assert chosen.factor == pytest.approx(STIFFER, rel=0.06)


def test_bodies_come_by_evidence_and_one_bodys_factors_are_well_apart():
    found = likely_bodies(bodies(), points(), struck(WALLS[1], 8))
    lags = [each.lag for each in found]
    assert lags[0] == 0.0
    assert lags == sorted(lags)
    for name in {each.name for each in found}:
        logs = sorted(math.log(each.factor) for each in found if each.name == name)
        assert all(high - low >= 0.2 - 1e-9 for low, high in itertools.pairwise(logs))


def test_a_lag_is_the_evidence_of_the_field_that_the_body_gives():
    measured = struck(WALLS[1], 8)
    first, second = likely_bodies(bodies(), points(), measured)[:2]
    strong = measured.strongest()
    evidence = []
    for each in (first, second):
        known = each.fit(strong).regression
        found = Regression.evidence_of(
            known.sites, known.prior[None], known.values, floor=known.floor, doubt=known.doubt
        )
        evidence.append(each.suits + float(found[0]))
    assert second.lag == pytest.approx(evidence[0] - evidence[1], rel=1e-9)


def test_where_frequencies_are_the_same_gains_decide():
    """A body that sounds alike but moves otherwise: its shapes are another's, in another order."""
    right = bodies()[1]
    order = torch.randperm(24, generator=torch.Generator().manual_seed(2))
    wrong = NominalBody(0.005, replace(right.elastic, shapes=right.elastic.shapes[:, order]))
    found = likely_bodies([wrong, right], points(), struck(WALLS[1], 8))
    assert found[0].name == right.name
    assert next(each.lag for each in found if each.name == wrong.name) > 20


def test_stray_modes_do_not_mislead():
    measured = struck(WALLS[1], 10)
    generator = torch.Generator().manual_seed(5)
    rows = torch.tensor([1, 4, 6, 11])
    values, frequency = measured.values.clone(), measured.frequency.clone()
    values[:, rows] = values[:, rows].square().mean(0).sqrt() * torch.randn(
        10, 4, 2, generator=generator, dtype=torch.float64
    )
    frequency[rows] *= torch.tensor([1.11, 0.93, 1.06, 0.9], dtype=torch.float64)
    chosen = likely_bodies(bodies(), points(), replace(measured, values=values, frequency=frequency))[0]
    assert chosen.name == bodies()[1].name
    assert chosen.factor == pytest.approx(STIFFER, rel=0.06)


def test_the_strongest_modes_ring_longest_and_keep_their_order():
    measured = struck(WALLS[1], 6)
    damping = measured.damping.clone()
    damping[3] = 1e6
    values = measured.values.clone()
    values[:, 5] *= 1e3
    strong = replace(measured, damping=damping, values=values).strongest(4)
    assert bool((strong.frequency.diff() > 0).all())
    assert measured.frequency[5] in strong.frequency
    assert measured.frequency[3] not in strong.frequency
    assert strong.values.shape == (6, 4, 2)
    assert strong.floor.shape == (6, 4)


def test_bodies_are_told_apart_by_themselves_where_their_names_are_alike():
    one, other = (NominalBody(wall, body.elastic) for wall, body in zip((0.00206, 0.00214), bodies()[:2], strict=True))
    assert one.name == other.name
    found = likely_bodies([one, other], points(), struck(WALLS[0], 8))
    assert found[0].body is one
    # Each has its own factors, of which the best of the other is near to the first's.
    alone = [len(likely_bodies([each], points(), struck(WALLS[0], 8))) for each in (one, other)]
    assert sum(each.body is one for each in found) == alone[0]
    assert any(each.body is other for each in found)
