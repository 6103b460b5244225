"""A flat bar whose elastic mode shapes are cosines, and gains that are drawn from what the gain model assumes."""

from functools import cache, partial

import torch
from torch import Tensor

from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.material import NOMINAL
from avmsf.field.gains.elastic import PERTURBATIONS, RESIDUALS, WIDTHS, Elastic
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture import NOISE_SHARES, KernelMixture
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.modal.modes import ModalBank
from factories.made_fields import mixture, sounding

LENGTH, WIDTH = 0.4, 0.1
SIZE = (LENGTH**2 + WIDTH**2) ** 0.5
ELASTIC = 100.0 * torch.arange(1, 7, dtype=torch.float64)
BANK = ModalBank(
    torch.tensor([105.0, 190.0, 310.0, 420.0], dtype=torch.float64),
    torch.tensor([5.0, 8.0, 12.0, 20.0], dtype=torch.float64),
)
"""Modes that are the elastic ones of the same rows, perturbed."""
DOWN = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
PERTURBATION, REMAINDER, NOISE = 0.3, 0.1, 0.03
"""Of the hypothesis that gains are drawn from, see `avmsf.field.gains.elastic`."""


def bar_points() -> Tensor:
    x, y = torch.linspace(0, LENGTH, 41), torch.linspace(0, WIDTH, 7)
    return torch.stack([*torch.meshgrid(x, y, indexing="ij"), torch.zeros(41, 7)], dim=2).reshape(-1, 3)


@cache
def bar() -> ElasticModes:
    """Return a sheet that faces up, with the points as nodes."""
    rows = torch.arange(41 * 7).reshape(41, 7)
    near, middle, far = rows[:-1:2], rows[1::2], rows[2::2]
    lower = [near[:, :-1:2], far[:, :-1:2], far[:, 2::2], middle[:, :-1:2], far[:, 1::2], middle[:, 1::2]]
    upper = [near[:, :-1:2], far[:, 2::2], near[:, 2::2], middle[:, 1::2], middle[:, 2::2], near[:, 1::2]]
    triangles = torch.cat([torch.stack([each.flatten() for each in half], dim=1) for half in (lower, upper)])
    nodes = bar_points().double()
    return ElasticModes(ELASTIC, nodes, triangles, cosines(nodes)[..., None] * DOWN, NOMINAL, 1.0)


def cosines(points: Tensor) -> Tensor:
    """Return what an impact straight down excites of each elastic mode."""
    return 2**0.5 * torch.cos(torch.pi * torch.arange(1, 7) * points[:, :1] / LENGTH)


def bar_contacts(count: int, *, seed: int = 0) -> Tensor:
    """Return some of the points, where shapes need no interpolation."""
    order = torch.randperm(41 * 7, generator=torch.Generator().manual_seed(seed))
    return bar_points()[order[:count]].double()


def sound_field(gains: object) -> SoundField:
    return sounding(gains, bank=BANK, noise=1e-6, rate=2000.0, samples=800, origin=Origin("bar"))


def impacts(contacts: Tensor) -> Sites:
    """Return impacts straight down."""
    return Sites(contacts, DOWN.expand_as(contacts))


def rows_of() -> Tensor:
    """Return the rows of the elastic kernels in which each mode is the elastic one of the same row, perturbed."""
    profiles, shapes, remainders = len(PERTURBATIONS) + len(WIDTHS), len(ELASTIC), len(RESIDUALS)
    rows = torch.arange(profiles * shapes * remainders).reshape(profiles, shapes, remainders)
    return rows[PERTURBATIONS.index(PERTURBATION), : len(BANK), RESIDUALS.index(REMAINDER)]


def drawn_gains(contacts: Tensor, *, seed: int) -> Tensor:
    """Return gains of contacts that are drawn from one hypothesis of the elastic family, [contacts, modes, 2]."""
    sites = impacts(contacts)
    covariance = Elastic(sites, SIZE, bar()).take(rows_of()).kernels()
    factor = torch.linalg.cholesky(covariance + 1e-9 * torch.eye(len(contacts), dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    smooth = factor @ torch.randn(4, len(contacts), 2, generator=generator, dtype=torch.float64)
    own = NOISE**0.5 * torch.randn(4, len(contacts), 2, generator=generator, dtype=torch.float64)
    return (smooth + own).transpose(0, 1)


def elastic_field(contacts: Tensor, values: Tensor, *, directional: bool = True) -> MixtureGains:
    """Return the model of gains at contacts with all families, or one that knows neither directions nor a body."""
    sites, complex_values = impacts(contacts), torch.view_as_complex(values.contiguous())
    body = [Elastic(sites, SIZE, bar())] if directional else []
    about = {"bank": BANK, "points": bar_points(), "size": SIZE, "variance": 0.0}
    return mixture(sites, complex_values, *body, directional=directional, **about)


positional_field = partial(elastic_field, directional=False)


def one_hypothesis(contacts: Tensor, values: Tensor) -> MixtureGains:
    """Return the model of a single hypothesis for each mode: that of `drawn_gains`."""
    sites, rows = impacts(contacts), rows_of()
    family = Elastic(sites, SIZE, bar()).take(rows)
    weights = torch.zeros(len(rows), len(NOISE_SHARES), 2 * len(rows), dtype=torch.float64)
    for row in range(len(rows)):
        weights[row, NOISE_SHARES.index(NOISE), [row, row + len(rows)]] = 1.0
    series = values.transpose(1, 2).flatten(1)
    mixture = KernelMixture(
        family.kernels(), series, torch.zeros(series.shape[1]).double(), weights, repetitions=sites.repetitions()
    )
    return MixtureGains(bar_points(), sites, (family,), mixture, True)
