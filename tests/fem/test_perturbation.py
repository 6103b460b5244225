"""First-order changes of modes with stiffness, density and Poisson's ratio, against bodies that were changed."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import STEEL
from avmsf.fem.perturbation import smooth_fields
from avmsf.fem.solid import Solid
from oracles.block import block

STEP = 1e-4


@cache
def body() -> Solid:
    return block((0.11, 0.07, 0.013), (5, 3, 1))


@cache
def nominal() -> ElasticModes:
    return elastic_modes(body(), STEEL, count=9, perturbed=True)


def fields() -> np.ndarray:
    return smooth_fields(SecondOrder.of(body()))


def squares(modes: ElasticModes) -> np.ndarray:
    return np.square(2.0 * np.pi * modes.frequency.numpy())


def test_the_squares_of_smooth_fields_sum_to_one_everywhere():
    assert np.allclose(np.square(fields()).sum(0), 1.0)


def test_frequencies_change_as_the_matrices_say():
    for row in (0, 3, 11):
        factor = 1.0 + STEP * torch.from_numpy(fields()[row])
        stiffer = squares(elastic_modes(body(), STEEL, count=9, stiffness_factor=factor))
        heavier = squares(elastic_modes(body(), STEEL, count=9, density_factor=factor))
        expected = STEP * np.diagonal(nominal().perturbations.stiffness[row])
        np.testing.assert_allclose(stiffer - squares(nominal()), expected, rtol=1e-3, atol=1e-3 * abs(expected).max())
        expected = -STEP * squares(nominal()) * np.diagonal(nominal().perturbations.mass[row])
        np.testing.assert_allclose(heavier - squares(nominal()), expected, rtol=1e-3, atol=1e-3 * abs(expected).max())


def test_frequencies_change_with_poissons_ratio_as_its_matrix_says():
    other = squares(elastic_modes(body(), replace(STEEL, poisson=STEEL.poisson + STEP), count=9))
    expected = STEP * np.diagonal(nominal().perturbations.poisson)
    np.testing.assert_allclose(other - squares(nominal()), expected, rtol=2e-3)


def test_shapes_mix_as_the_matrices_say():
    row, places = 5, body().points[::7]
    basis = elastic_modes(body(), STEEL, count=40, perturbed=True)
    step = 0.05
    factor = 1.0 + step * torch.from_numpy(fields()[row])
    changed = elastic_modes(body(), STEEL, count=3, stiffness_factor=factor).at(places)
    apart = squares(basis)[:, None] - squares(basis)
    np.fill_diagonal(apart, np.inf)
    mixing = torch.from_numpy(-step * basis.perturbations.stiffness[row] / apart)
    predicted = basis.at(places) + torch.einsum("cjd,jk->ckd", basis.at(places), mixing)
    for mode in range(3):
        sign = torch.sign((changed[:, mode] * predicted[:, mode]).sum())
        moved = (changed[:, mode] - sign * basis.at(places)[:, mode]).norm()
        assert (changed[:, mode] - sign * predicted[:, mode]).norm() < 0.3 * moved
