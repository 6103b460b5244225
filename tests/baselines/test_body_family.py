"""A body's modes as functions of its wall's thickness, against direct solves."""

from functools import cache

import numpy as np
import pytest
import torch

from avmsf.baselines.diffsound.body_family import BodyFamily, body_family
from avmsf.errors import SimulationError
from avmsf.mesh.surface import Surface
from factories.made_sheet import sheet_over


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
