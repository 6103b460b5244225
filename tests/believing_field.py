"""A flat bar whose elastic shapes are cosines, and fields of gains that are drawn from what such fields believe."""

import torch
from torch import Tensor

from avmsf.field.elasticpoints import ElasticPoints
from avmsf.field.evidence import Regression
from avmsf.field.hypotheses import nearness
from avmsf.field.modalbasis import ModalBasis, sites_of
from avmsf.field.soundfield import Origin, SoundField
from avmsf.field.thinplategains import ThinPlateGains, thin_plate_gains
from avmsf.modal.bank import ModalBank
from avmsf.modal.residual import Residual

LENGTH, WIDTH = 0.4, 0.1
ELASTIC = 100.0 * torch.arange(1, 7, dtype=torch.float64)
BANK = ModalBank(
    torch.tensor([105.0, 190.0, 310.0, 420.0], dtype=torch.float64),
    torch.tensor([5.0, 8.0, 12.0, 20.0], dtype=torch.float64),
)
DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
FIRST = (0, 0, 3)
"""Rows of width, remainder and noise of one hypothesis."""


def bar_points() -> Tensor:
    x, y = torch.linspace(0, LENGTH, 41), torch.linspace(0, WIDTH, 7)
    return torch.stack([*torch.meshgrid(x, y, indexing="ij"), torch.zeros(41, 7)], dim=2).reshape(-1, 3)


def bar_surface() -> ElasticPoints:
    points = bar_points()
    order = torch.arange(1, 7)
    along = 2**0.5 * torch.cos(torch.pi * order * points[:, :1] / LENGTH)
    return ElasticPoints(points, DOWN.float().expand(len(points), 3), along[..., None] * DOWN.float())


def bar_contacts(count: int, *, seed: int = 0) -> Tensor:
    """Return some of the points, where shapes need no interpolation."""
    order = torch.randperm(41 * 7, generator=torch.Generator().manual_seed(seed))
    return bar_points()[order[:count]].double()


def sound_field(gains: object) -> SoundField:
    return SoundField(
        BANK, gains, torch.zeros(4, dtype=torch.float64), Residual(torch.full((9,), 1e-6)), 2000.0, 800, Origin("bar")
    )  # type: ignore[arg-type]


def drawn_gains(contacts: Tensor, *, seed: int, noise: float = 0.03, remainder: float = 0.1) -> Tensor:
    """Return gains of contacts, drawn from what the regression takes gains to be, [contacts, modes, 2]."""
    surface = bar_surface()
    directions = DOWN.expand(len(contacts), 3)
    sites, _ = sites_of(surface, contacts, directions)
    prior = nearness(BANK.frequency, ELASTIC)[:, 1]
    prior = prior / prior.sum(1, keepdim=True)
    elastic = torch.einsum("ck,mk,dk->mcd", sites.shapes, prior, sites.shapes)
    covariance = (1 - remainder) * elastic + remainder * sites.remainder
    factor = torch.linalg.cholesky(covariance + 1e-9 * torch.eye(len(contacts), dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    smooth = factor @ torch.randn(4, len(contacts), 2, generator=generator, dtype=torch.float64)
    own = noise**0.5 * torch.randn(4, len(contacts), 2, generator=generator, dtype=torch.float64)
    return (smooth + own).transpose(0, 1)


def physics_field(contacts: Tensor, values: Tensor, *, only: tuple[int, int, int] | None = None) -> ModalBasis:
    """Return the field of gains at contacts; of one hypothesis alone where `only` names it."""
    surface = bar_surface()
    directions = DOWN.expand(len(contacts), 3)
    sites, prior = sites_of(surface, contacts, directions)[0], nearness(BANK.frequency, ELASTIC)
    floor, doubt = torch.zeros(values.shape[:2], dtype=torch.float64), torch.ones(len(contacts), dtype=torch.float64)
    regression = Regression.of(sites, prior, values, floor=floor, doubt=doubt)
    if only is not None:
        width, remainder, noise = only
        weights = torch.zeros_like(regression.weights)
        weights[(width * 3 + remainder) * 6 + noise] = 1.0
        regression = Regression(sites, prior, values, floor, doubt, weights)
    return ModalBasis(surface, contacts, directions, regression)


def spline_field(contacts: Tensor, values: Tensor) -> ThinPlateGains:
    return thin_plate_gains(contacts, values, importance=1 / (4 * BANK.damping), points=bar_points())
