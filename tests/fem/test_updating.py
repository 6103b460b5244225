"""First-order changes of modes against bodies that were changed, and model updating on known departures."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import NOMINAL, STEEL
from avmsf.fem.perturbation import smooth_fields
from avmsf.fem.solid import Solid
from avmsf.fem.updating import TOLERANCES, Matched, update
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, matched
from avmsf.field.gains.kernels import Sites, Smooth, Unstructured
from oracles.block import block

STEP = 1e-4


@cache
def small() -> Solid:
    return block((0.11, 0.07, 0.013), (5, 3, 1))


@cache
def steel() -> ElasticModes:
    return elastic_modes(small(), STEEL, count=9, perturbed=True)


def fields() -> np.ndarray:
    return smooth_fields(SecondOrder.of(small()))


def squares(modes: ElasticModes) -> np.ndarray:
    return np.square(2.0 * np.pi * modes.frequency.numpy())


def test_the_squares_of_smooth_fields_sum_to_one_everywhere():
    assert np.allclose(np.square(fields()).sum(0), 1.0)


def test_frequencies_change_as_the_matrices_say():
    for row in (0, 3, 11):
        factor = 1.0 + STEP * torch.from_numpy(fields()[row])
        stiffer = squares(elastic_modes(small(), STEEL, count=9, stiffness_factor=factor))
        heavier = squares(elastic_modes(small(), STEEL, count=9, density_factor=factor))
        expected = STEP * np.diagonal(steel().perturbations.stiffness[row])
        np.testing.assert_allclose(stiffer - squares(steel()), expected, rtol=1e-3, atol=1e-3 * abs(expected).max())
        expected = -STEP * squares(steel()) * np.diagonal(steel().perturbations.mass[row])
        np.testing.assert_allclose(heavier - squares(steel()), expected, rtol=1e-3, atol=1e-3 * abs(expected).max())


def test_frequencies_change_with_poissons_ratio_as_its_matrix_says():
    other = squares(elastic_modes(small(), replace(STEEL, poisson=STEEL.poisson + STEP), count=9))
    expected = STEP * np.diagonal(steel().perturbations.poisson)
    np.testing.assert_allclose(other - squares(steel()), expected, rtol=2e-3)


def test_shapes_mix_as_the_matrices_say():
    row, places = 5, small().points[::7]
    basis = elastic_modes(small(), STEEL, count=40, perturbed=True)
    step = 0.05
    factor = 1.0 + step * torch.from_numpy(fields()[row])
    changed = elastic_modes(small(), STEEL, count=3, stiffness_factor=factor).at(places)
    apart = squares(basis)[:, None] - squares(basis)
    np.fill_diagonal(apart, np.inf)
    mixing = torch.from_numpy(-step * basis.perturbations.stiffness[row] / apart)
    predicted = basis.at(places) + torch.einsum("cjd,jk->ckd", basis.at(places), mixing)
    for mode in range(3):
        sign = torch.sign((changed[:, mode] * predicted[:, mode]).sum())
        moved = (changed[:, mode] - sign * basis.at(places)[:, mode]).norm()
        assert (changed[:, mode] - sign * predicted[:, mode]).norm() < 0.3 * moved


MODES = 14


@cache
def body() -> Solid:
    return block((0.2, 0.13, 0.006), (8, 5, 1))


@cache
def nominal() -> ElasticModes:
    return elastic_modes(body(), NOMINAL, count=40, perturbed=True)


@cache
def uneven(kind: str) -> ElasticModes:
    """Return the body as it is: stiffness or density departs by 1.5 or 2 prior deviations."""
    fields = smooth_fields(SecondOrder.of(body()))
    deviation = {"stiffness_factor": 1.5 * TOLERANCES.stiffness_std, "density_factor": 2.0 * TOLERANCES.density_std}[
        kind
    ]
    drawn = np.random.default_rng(3).normal(0.0, deviation, len(fields))
    return elastic_modes(body(), NOMINAL, count=MODES, **{kind: torch.from_numpy(np.exp(drawn @ fields))})


def sites(seed: int, count: int) -> Sites:
    drawn = np.random.default_rng(seed).uniform(size=(count, 3)) * [0.2, 0.13, 0.0] + [0.0, 0.0, 0.006]
    points = torch.from_numpy(drawn)
    return Sites(points, torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(count, 3).clone())


def updated(true: ElasticModes) -> tuple[ElasticModes, float] | None:
    known, size = sites(1, 12), 0.24
    values = true.gains(known.points, known.directions)[:, :MODES]
    noise = torch.from_numpy(np.random.default_rng(5).normal(size=(2, *values.shape))) * 0.02 * values.std(0)
    gains = torch.complex(values + noise[0], noise[1])
    weak = torch.full((MODES,), 1e-12, dtype=torch.float64)
    measured = MeasuredGains(gains, weak, true.frequency[:MODES], torch.full((MODES,), 5.0, dtype=torch.float64))
    others = [WeighedFamily.of(family, measured) for family in (Unstructured(known, size), Smooth(known, size))]
    return update(
        nominal(), known.points, known.directions, measured.frequency, values + noise[0],
        measured.informative[:MODES],
        lambda modes: matched(others, Elastic(known, size, modes), measured),
    )  # fmt: skip


def agreement(found: ElasticModes, true: ElasticModes) -> torch.Tensor:
    """Return the modal assurance criterion of each true shape with the most similar one, at places not struck."""
    other = sites(2, 60)
    here, there = (each.gains(other.points, other.directions) for each in (found, true))
    here, there = here / here.norm(dim=0), there[:, :MODES] / there[:, :MODES].norm(dim=0)
    return (here.T @ there).square().amax(0)


@pytest.mark.parametrize("kind", ["stiffness_factor", "density_factor"])
def test_shapes_at_places_not_struck_and_frequencies_come_nearer_to_the_true_ones(kind):
    true = uneven(kind)
    found = updated(true)
    assert found is not None
    modes, nats = found
    assert nats > 10.0
    before, after = (1.0 - agreement(each, true) for each in (nominal(), modes))
    assert after.mean() < 0.5 * before.mean()
    ratio = [torch.log(each.frequency[:MODES] / true.frequency).std() for each in (nominal(), modes)]
    assert ratio[1] < 0.5 * ratio[0]


def test_a_body_that_is_the_nominal_one_stays_as_it_is():
    assert updated(replace(nominal(), frequency=1.2 * nominal().frequency)) is None


def test_silent_and_doubled_modes_say_nothing_of_the_body():
    true, known = uneven("stiffness_factor"), sites(1, 12)
    values = true.gains(known.points, known.directions)
    values[:, 2] = 0.0
    twice = torch.cat([values, 0.5 * values[:, 3:4]], dim=1)
    frequency = torch.cat([true.frequency, true.frequency[3:4] + 0.1])
    damping = torch.full((MODES + 1,), 5.0, dtype=torch.float64)
    measured = MeasuredGains(twice.to(torch.complex128), torch.full_like(damping, 1e-12), frequency, damping)
    usable = measured.informative[: MODES + 1]
    assert usable.tolist() == [row not in (2, MODES) for row in range(MODES + 1)]
    family = WeighedFamily.of(Smooth(known, 0.24), measured)

    def match(modes: ElasticModes) -> Matched:
        return matched([family], Elastic(known, 0.24, modes), measured)

    found = update(nominal(), known.points, known.directions, frequency, twice, usable, match)
    assert bool(torch.isfinite(found[0].shapes).all())
