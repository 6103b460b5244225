"""A made dome: walls to choose from, and what is true of it."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from avmsf.features.feature_field import FeatureField
from avmsf.fem.candidate_bodies import CandidateBody
from avmsf.fem.elastic_modes import ElasticModes, elastic_modes
from avmsf.fem.material import NOMINAL
from avmsf.fem.walls import shell
from avmsf.mesh.surface import Surface
from factories.made_sheet import sheet_over

WALLS = (0.0015, 0.004, 0.01)
STIFFER = 1.25
"""Of the made objects over what their stiffness is taken to be: a factor on all frequencies."""


@cache
def dome() -> Surface:
    """Return a shallow dome, whose shapes change with its wall as those of a flat sheet do not."""
    return sheet_over(np.linspace(-0.12, 0.12, 13), np.linspace(-0.09, 0.09, 11), lambda x, y: -1.5 * x**2 - 2.5 * y**2)


@cache
def bodies() -> tuple[CandidateBody, ...]:
    return tuple(
        CandidateBody(wall, elastic_modes(shell(dome(), thickness=wall, detail=0.09), NOMINAL, count=24))
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
    return FeatureField.from_mesh(dome(), seed=0, count=1500).points
