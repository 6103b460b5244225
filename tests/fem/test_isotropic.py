"""A body's modes as functions of its material, against direct solves."""

from functools import cache

import pytest
import torch

from avmsf.errors import SimulationError
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.isotropic import IsotropicModes, isotropic_modes
from avmsf.fem.material import STEEL, WOOD, Material
from avmsf.fem.solid import Solid
from oracles.block import block


@cache
def solid() -> Solid:
    return block((0.12, 0.07, 0.02), (5, 3, 1))


@cache
def body() -> IsotropicModes:
    return isotropic_modes(solid(), count=8)


def direct(material: Material) -> ElasticModes:
    return elastic_modes(solid(), material, count=8)


def test_frequencies_are_those_of_direct_solves_at_any_material():
    for density, young, poisson in ((1234.0, 5e9, 0.02), (1234.0, 5e9, 0.19), (2.0, 1e7, 0.3), (2.0, 4e7, 0.45)):
        material = Material("some", density, young, poisson, 0.0, 0.0)
        torch.testing.assert_close(body().modes(material).frequency, direct(material).frequency, rtol=3e-4, atol=0.0)


def test_shapes_are_those_of_direct_solves():
    for material in (STEEL, WOOD):
        found, known = body().modes(material), direct(material)
        both = (found.shapes * known.shapes).sum(dim=(0, 2))
        alike = both.abs() / (found.shapes.square().sum(dim=(0, 2)) * known.shapes.square().sum(dim=(0, 2))).sqrt()
        assert float(alike.min()) > 0.999
        size = found.shapes.square().sum(dim=(0, 2)) / known.shapes.square().sum(dim=(0, 2))
        torch.testing.assert_close(size, torch.ones_like(size), rtol=2e-3, atol=0.0)
        assert found.mass == pytest.approx(known.mass, rel=1e-12)


def test_the_gradient_by_poissons_ratio_is_that_of_differences():
    ratio = torch.tensor(0.27, dtype=torch.float64, requires_grad=True)
    weights = torch.arange(1.0, 9.0, dtype=torch.float64)
    (weights @ body().squares(ratio)).backward()
    with torch.no_grad():
        above, below = (weights @ body().squares(ratio + step) for step in (1e-5, -1e-5))
    assert ratio.grad is not None
    torch.testing.assert_close(ratio.grad, (above - below) / 2e-5, rtol=1e-5, atol=0.0)


def test_a_body_of_two_parts_is_refused():
    one = solid()
    two = Solid.build(torch.cat([one.points, one.points + 1.0]), torch.cat([one.cells, one.cells + len(one.points)]))
    with pytest.raises(SimulationError):
        isotropic_modes(two, count=3)
