"""Impacts on a plate whose mode shapes are products of cosines, and gain models of them, made in a moment."""

from functools import cache

import torch

from avmsf.fem.elastic_modes import ElasticModes
from avmsf.field.gains.elastic import Elastic
from avmsf.field.gains.fitting import MeasuredGains, fit_mixture
from avmsf.field.gains.kernels import KernelFamily, Sites, Smooth, ThinPlate, Unstructured
from avmsf.field.gains.mixture_gains import MixtureGains
from factories.made_modes import sliding_plate

SIDES = (0.24, 0.17, 0.004)
SIZE = float(torch.tensor(SIDES, dtype=torch.float64).norm())
POSITIONAL = (Unstructured, Smooth, ThinPlate)


@cache
def plate() -> ElasticModes:
    return sliding_plate()


def draw(*size: int, seed: int) -> torch.Tensor:
    return torch.rand(*size, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 0.5


def impacts(count: int, *, seed: int, askew: float = 0.5) -> Sites:
    """Return impacts on both of the plate's large faces, into the plate but for `askew`."""
    points = draw(count, 3, seed=seed) * torch.tensor(SIDES, dtype=torch.float64)
    points[:, 2] = torch.where(points[:, 2] < 0, -0.5, 0.5) * SIDES[2]
    directions = 2.0 * askew * draw(count, 3, seed=seed + 1000)
    directions[:, 2] = -points[:, 2].sign()
    # Such that float32 holds the points exactly.
    return Sites(points.float().double(), directions / directions.norm(dim=1, keepdim=True))


def families(sites: Sites, *, elastic: bool = True) -> list[KernelFamily]:
    found: list[KernelFamily] = [kind(sites, SIZE) for kind in POSITIONAL]
    return [*found, Elastic(sites, SIZE, plate())] if elastic else found


def measured(sites: Sites, *, noise: float = 0.02, factor: float = 1.0) -> MeasuredGains:
    """Return gains of the plate's first five modes, the imaginary parts a third of the real ones, and noise."""
    shapes = plate().gains(sites.points, sites.directions)[:, :5] * torch.linspace(2.0, 0.5, 5, dtype=torch.float64)
    parts = torch.stack([shapes, shapes / 3.0], dim=2)
    parts = parts + noise * shapes.std() * (12.0**0.5) * draw(*parts.shape, seed=3)
    damping = torch.tensor([12.0, 15.0, 30.0, 22.0, 60.0], dtype=torch.float64)
    variance = torch.full((5,), 1e-5, dtype=torch.float64)
    return MeasuredGains(torch.view_as_complex(parts), variance, factor * plate().frequency[:5], damping)


@cache
def model(*, elastic: bool = True, directional: bool = True, count: int = 14) -> MixtureGains:
    """Return the model of some impacts, two of them at one place; the second mode is affine, the last one noise."""
    sites = impacts(count, seed=1)
    sites = sites.take(torch.tensor([*range(count - 1), 0]))
    gains, points = measured(sites), impacts(50, seed=9).points.float()
    gains.values[:, 1] += sites.directions[:, 2] * (1.0 + sites.points @ (40.0 * draw(3, seed=6))) * (300.0 - 100.0j)
    gains.values[:, 4] = torch.view_as_complex(draw(count, 2, seed=7))
    return fit_mixture(families(sites, elastic=elastic), gains, points, directional=directional)
