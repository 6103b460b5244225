"""Which wall lies behind a dome, and how stiff it is, from the gains of a few blows."""

import itertools
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from avmsf.capture.surface import Surface
from avmsf.field.bodychoice import MeasuredGains, likely_bodies
from avmsf.field.suspects import agreeing
from avmsf.scene.features import FeatureField
from avmsf.simulate.elastic import ElasticModes, elastic_modes
from avmsf.simulate.nominal import NOMINAL, NominalBody
from avmsf.simulate.shell import shell

WALLS = (0.0015, 0.004, 0.01)
STIFFER = 1.25
"""Of the made objects over what their stiffness is taken to be: a factor on all frequencies."""


@cache
def dome() -> Surface:
    """Return a shallow dome, whose shapes change with its wall as those of a flat sheet do not."""
    x, y = np.meshgrid(np.linspace(-0.12, 0.12, 13), np.linspace(-0.09, 0.09, 11), indexing="ij")
    rows = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points = np.stack([x.ravel(), y.ravel(), (-1.5 * x**2 - 2.5 * y**2).ravel()], axis=1)
    return Surface(torch.from_numpy(points).float(), torch.from_numpy(faces))


@cache
def bodies() -> tuple[NominalBody, ...]:
    return tuple(
        NominalBody(wall, elastic_modes(shell(dome(), thickness=wall, detail=0.09), NOMINAL, count=24))
        for wall in WALLS
    )


@cache
def truth(wall: float) -> ElasticModes:
    """Return a dome of finer elements, whose material scatters by a tenth."""
    solid = shell(dome(), thickness=wall, detail=0.07)
    generator = torch.Generator().manual_seed(1)
    uneven = torch.exp(0.1 * torch.randn(len(solid.cells), generator=generator, dtype=torch.float64))
    return elastic_modes(solid, replace(NOMINAL, young=STIFFER**2 * NOMINAL.young), count=20, stiffness_factor=uneven)


@cache
def points() -> torch.Tensor:
    return FeatureField.from_mesh(dome(), generator=torch.Generator().manual_seed(0), count=1500).points


def struck(wall: float, count: int, *, seed: int = 0, noise: float = 0.03) -> MeasuredGains:
    """Return the gains of blows straight into a made dome, with noise over each mode's size."""
    generator = torch.Generator().manual_seed(seed)
    contacts = points()[torch.randperm(len(points()), generator=generator)[:count]]
    elastic = truth(wall)
    directions = -elastic.normals(contacts)
    gains = elastic.gains(contacts, directions)
    values = torch.stack([gains, 0.2 * gains], dim=2)
    size = values.square().mean(0, keepdim=True).sqrt()
    return MeasuredGains(
        contacts,
        directions.float(),
        values + noise * size * torch.randn(values.shape, dtype=torch.float64, generator=generator),
        elastic.frequency,
        torch.full_like(elastic.frequency, 10.0),
        torch.zeros(count, len(elastic), dtype=torch.float64),
        torch.ones(count, dtype=torch.float64),
    )


@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("count", [6, 12])
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
    one, other = (each.suits + each.fit(strong).regression.evidence for each in (first, second))
    assert second.lag == pytest.approx(one - other, rel=1e-9)


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
