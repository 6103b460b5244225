"""Bodies held at a face, an edge or a point."""

import math

import numpy as np
import pytest
import torch

from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import NOMINAL
from avmsf.fem.solid import Solid
from avmsf.fem.supports import supports_of
from oracles.block import block


def standing(solid: Solid) -> Solid:
    """The solid, its x axis upwards."""
    return Solid.build(solid.points[:, [1, 2, 0]], solid.cells)


def test_a_bar_held_at_its_lower_end_is_a_cantilever():
    length, height, width = 0.2, 0.005, 0.008
    solid = standing(block((length, height, width), (16, 1, 1)))
    mesh = SecondOrder.of(solid)
    [support] = supports_of(mesh)
    assert support.name == "held at its lowest point"
    modes = elastic_modes(solid, NOMINAL, count=4, fixed=support.nodes(mesh))
    speed = math.sqrt(NOMINAL.young / NOMINAL.density)
    # 1 + cosh x cos x = 0 at x = 1.8751, for bending in the plane of either side.
    expected = [1.8751**2 / (2 * math.pi) * speed * side / math.sqrt(12) / length**2 for side in (height, width)]
    assert modes.frequency[:2].tolist() == pytest.approx(expected, rel=0.02)
    lower = modes.nodes[:, 2] < 1e-6
    assert float(modes.shapes[lower].abs().max()) == 0.0


def test_a_lying_plate_may_be_held_along_each_of_its_sides():
    mesh = SecondOrder.of(block((0.24, 0.16, 0.003), (12, 8, 1)))
    found = supports_of(mesh)
    # Not at its face, which is half of it.
    assert [each.name for each in found] == [f"held along lower edge {number}" for number in range(1, 5)]
    sides = [mesh.nodes[each.nodes(mesh)] for each in found]
    assert [round(float(np.ptp(side[:, :2], axis=0).max()), 6) for side in sides] == [0.24, 0.24, 0.16, 0.16]
    assert all(np.ptp(side[:, :2], axis=0).min() < 0.01 for side in sides)


def test_a_cone_on_its_tip_is_held_at_a_point():
    flat = block((1.0, 1.0, 1.0), (4, 4, 4))
    points = flat.points.clone()
    points[:, :2] = (points[:, :2] - 0.5) * (0.05 + points[:, 2:])
    [support] = supports_of(SecondOrder.of(Solid.build(points, flat.cells)))
    assert support.name == "held at its lowest point"


def test_a_body_that_turns_about_its_support_has_no_mode_at_zero():
    solid = block((0.1, 0.02, 0.01), (6, 2, 1))
    edge = np.flatnonzero((SecondOrder.of(solid).nodes[:, [0, 2]] == 0).all(axis=1))
    frequency = elastic_modes(solid, NOMINAL, count=4, fixed=edge).frequency
    assert bool(torch.isfinite(frequency).all())
    assert float(frequency[0]) > 100.0
