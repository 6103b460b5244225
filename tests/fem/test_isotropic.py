"""A body's modes as functions of its material and of its wall's thickness, against direct solves."""

from functools import cache

import numpy as np
import pytest
import torch

from avmsf.errors import SimulationError
from avmsf.fem.body_family import BodyFamily, body_family
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.isotropic import IsotropicModes, isotropic_modes
from avmsf.fem.material import STEEL, WOOD, Material
from avmsf.fem.solid import Solid
from avmsf.mesh.surface import Surface
from factories.made_sheet import sheet_over
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
    for poisson in (0.02, 0.19, 0.3, 0.45):
        material = Material("some", 1234.0, 5e9, poisson, 0.0, 0.0)
        torch.testing.assert_close(body().modes(material).frequency, direct(material).frequency, rtol=3e-4, atol=0.0)


def test_frequencies_grow_with_the_root_of_stiffness_over_density():
    one, four = (body().modes(Material("some", 2.0, young, 0.3, 0.0, 0.0)).frequency for young in (1e7, 4e7))
    torch.testing.assert_close(four, 2.0 * one, rtol=1e-12, atol=0.0)


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


@cache
def sheet() -> Surface:
    # A little bent, so that stretching takes part.
    return sheet_over(np.linspace(0, 0.2, 9), np.linspace(0, 0.14, 7), lambda x, y: 0.4 * x**2)


@cache
def walls() -> BodyFamily:
    return body_family(sheet(), count=6, dofs=3000)


def test_an_open_sheet_has_walls_whose_frequencies_between_thicknesses_are_those_of_direct_solves():
    family, ratio = walls(), torch.tensor(0.3, dtype=torch.float64)
    assert family.walled
    between = float(np.sqrt(family.thickness[1] * family.thickness[2]))
    found = family.squares(ratio, torch.tensor(between, dtype=torch.float64).log()).sqrt()
    error = (found / family.at(between).squares(ratio).sqrt() - 1.0).abs()
    # Where two modes change places the curves of sorted frequencies have a kink.
    assert float(error.mean()) < 0.015
    assert float(error.max()) < 0.05


def test_a_family_is_exact_at_a_thickness_that_it_includes():
    family, ratio = walls(), torch.tensor(0.3, dtype=torch.float64)
    between = 1.2 * family.thickness[1]
    place = torch.tensor(between, dtype=torch.float64).log()
    known = family.at(between).squares(ratio)
    torch.testing.assert_close(family.including(between).squares(ratio, place), known, rtol=1e-9, atol=0.0)


def test_thin_walls_bend_in_proportion_to_their_thickness():
    flat = Surface(sheet().vertices * torch.tensor([1.0, 1.0, 0.0]), sheet().faces)
    family = body_family(flat, count=4, dofs=3000)
    ratio = torch.tensor(0.3, dtype=torch.float64)
    first, second = (each.squares(ratio).sqrt() for each in family.bodies[:2])
    thicker = family.thickness[1] / family.thickness[0]
    torch.testing.assert_close(second / first, torch.full_like(first, thicker), rtol=0.03, atol=0.0)


def test_points_without_triangles_are_refused():
    with pytest.raises(SimulationError):
        body_family(Surface(sheet().vertices, torch.zeros(0, 3, dtype=torch.int64)), count=3)
