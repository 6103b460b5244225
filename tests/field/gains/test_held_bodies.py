"""The support of an object, found from the gains of its modes."""

from functools import cache

import numpy as np
import pytest
import torch

from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import NOMINAL, STEEL
from avmsf.fem.supports import FREE, supports_of
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, WeighedFamily, total_evidence
from avmsf.field.gains.kernels import Sites, Smooth, ThinPlate, Unstructured
from factories.gain_cases import draw
from oracles.block import block

SIDES = (0.24, 0.16, 0.003)
CLAMPED = "held along lower edge 3"


@cache
def candidates() -> dict[str, ElasticModes]:
    """A coarse plate of nominal material, free and held along each of its sides."""
    solid = block(SIDES, (9, 6, 1))
    mesh = SecondOrder.of(solid)
    fixed = {FREE: None} | {each.name: each.nodes(mesh) for each in supports_of(mesh)}
    return {name: elastic_modes(solid, NOMINAL, count=16, fixed=nodes) for name, nodes in fixed.items()}


def recorded(support: str, count: int = 12) -> tuple[Sites, MeasuredGains]:
    """Impacts on a finer plate of steel that is stiffer at one end."""
    solid = block(SIDES, (13, 8, 1))
    mesh = SecondOrder.of(solid)
    fixed = {FREE: None} | {each.name: each.nodes(mesh) for each in supports_of(mesh)}
    stiffness = 1.0 + 0.5 * solid.points[solid.cells].mean(1)[:, 0]
    true = elastic_modes(solid, STEEL, count=10, stiffness_factor=stiffness, fixed=fixed[support])
    points = (draw(count, 3, seed=4) + 0.5) * torch.tensor(SIDES, dtype=torch.float64)
    points[:, 2] = SIDES[2]
    sites = Sites(points, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(count, 3))
    gains = true.gains(sites.points, sites.directions)
    gains = gains + 0.03 * np.sqrt(12.0) * gains.std() * draw(count, 10, seed=5)
    variance = torch.full((10,), 1e-5, dtype=torch.float64)
    return sites, MeasuredGains(gains.to(torch.complex128), variance, true.frequency, 8.0 + 0.01 * true.frequency)


@pytest.mark.parametrize("support", [FREE, CLAMPED])
def test_the_support_of_a_plate_is_the_most_probable(support: str):
    sites, gains = recorded(support)
    size = float(np.linalg.norm(SIDES))
    others = [WeighedFamily.of(kind(sites, size), gains) for kind in (Unstructured, Smooth, ThinPlate)]
    evidence = {
        name: total_evidence([*others, WeighedFamily.of(Elastic(sites, size, modes), gains)], gains)
        for name, modes in candidates().items()
    }
    true = evidence.pop(support)
    # Two nats a mode.
    assert true > max(evidence.values()) + 20
