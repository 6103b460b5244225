"""What may be true of each measured mode's gains before they are weighed: a grid of Gaussian fields, and their sizes.

Gains y at the contacts are one draw of a Gaussian field with the covariance

    s^2 [(1 - p) sum_k g_k phi_k(x) phi_k(x') + p r(x, x')] + s^2 q I,

where phi_k is the component of elastic shape k along the blow, r a smooth kernel, and g_k = exp(-(log f/f_k)^2 / 2 w^2)
+ `FARTHEST` says that a mode draws on shapes near to it in frequency. How near (w), how smooth a remainder (p) and how
much noise (q) is not known: every combination of a grid is a hypothesis, whose evidence is the likelihood of y with s
integrated out (prior 1/s).
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int
from torch import Tensor

WIDTHS = (0.05, 0.1, 0.2, 0.4)
"""Standard deviations of the log of measured over elastic frequency."""
REMAINDERS = (0.03, 0.1, 0.3)
"""Parts of a mode's gains that no elastic shape has."""
NOISES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Variances of the noise over the gains'."""
COUNT = len(WIDTHS) * len(REMAINDERS) * len(NOISES)
"""Hypotheses: each noise in turn, for each remainder, for each width."""
FARTHEST = 1e-3
"""Prior variance of the shapes that are not near at all, over that of the nearest."""
UNHEARD = 1e6
"""Factor on the noise's variance of a contact that says nothing, and that is not counted."""
MEMORY = 4_000_000
"""Numbers of a batch of matrices."""
_EVERY = torch.arange(COUNT)
_SILENT = 1e-20
"""Energy of gains over the strongest's, up to which they are none."""


@dataclass(frozen=True, eq=False)
class Sites:
    """What is known beforehand of the gains at contacts."""

    shapes: Float64[Tensor, "contacts shapes"]
    """Elastic shapes along the blows, each of mean square one over the object."""
    remainder: Float64[Tensor, "contacts contacts"]
    """The smooth kernel between all pairs, one on the diagonal."""


def nearness(
    frequency: Float64[Tensor, " modes"], elastic: Float64[Tensor, " shapes"]
) -> Float64[Tensor, "modes widths shapes"]:
    """Return the prior variances of the shapes' weights in each mode, for each width; frequencies in Hz."""
    apart = torch.log(frequency[:, None] / elastic)
    widths = torch.tensor(WIDTHS, dtype=torch.float64)
    return torch.exp(-0.5 * (apart[:, None, :] / widths[:, None]).square()) + FARTHEST


def row_of(width: int, remainder: int, noise: int) -> int:
    """Return the hypothesis of a width, a remainder and a noise, by their rows in their tables."""
    return (width * len(REMAINDERS) + remainder) * len(NOISES) + noise


def rows_of(hypotheses: Int[Tensor, " hypotheses"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the rows of each hypothesis's width, remainder and noise in their tables."""
    rest = hypotheses // len(NOISES)
    return rest // len(REMAINDERS), rest % len(REMAINDERS), hypotheses % len(NOISES)


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """The grid of Gaussian fields that the gains at some contacts may be draws of.

    Methods give what they return for some modes, by rows, and for some hypotheses of the grid, or all.
    """

    sites: Sites
    prior: Float64[Tensor, "modes widths shapes"]
    """Of `nearness`."""
    values: Float64[Tensor, "contacts modes 2"]
    """Gains at the contacts, in two parts that are independent of each other."""
    floor: Float64[Tensor, "contacts modes"]
    """Variance of the gains by the extraction's own error, over the gains' mean square: added to every noise."""
    doubt: Float64[Tensor, " contacts"]
    """Factor on the noise's variance: one for a contact that is trusted, `UNHEARD` for one that says nothing."""

    @cached_property
    def heard(self) -> Bool[Tensor, " contacts"]:
        """Whether each contact says something."""
        return self.doubt < UNHEARD

    @cached_property
    def count(self) -> int:
        """How many contacts do, at least one."""
        return max(int(self.heard.sum()), 1)

    def batches(self) -> tuple[Int[Tensor, " modes"], ...]:
        """Return the modes in parts whose covariances by all hypotheses fit into `MEMORY`."""
        size = max(1, MEMORY // (COUNT * len(self.values) ** 2))
        return torch.split(torch.arange(self.prior.shape[0]), size)

    @cached_property
    def silent(self) -> Bool[Tensor, "modes 2"]:
        """Whether each part of each mode has no gains at all: nothing, then, tells of how they spread."""
        power = self.values.square().sum(0)
        return power <= _SILENT * power.max()

    def scaled_prior(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "modes widths shapes"]:
        """Return the prior variances, such that gains at the contacts are of mean square one."""
        prior = self.prior[modes]
        size = torch.einsum("ck,mwk->mw", self.sites.shapes[self.heard].square(), prior) / self.count
        return prior / size.clamp_min(torch.finfo(torch.float64).tiny)[..., None]

    def noise(
        self, modes: Int[Tensor, " modes"], hypotheses: Int[Tensor, " hypotheses"] | None = None
    ) -> Float64[Tensor, "hypotheses modes contacts"]:
        """Return the variance over s^2 that each gain has of its own."""
        _, _, row = rows_of(_EVERY if hypotheses is None else hypotheses)
        size = torch.tensor(NOISES, dtype=torch.float64)[row, None] * self.doubt
        return size[:, None] + self.floor[:, modes].T

    def covariance(
        self, modes: Int[Tensor, " modes"], hypotheses: Int[Tensor, " hypotheses"] | None = None
    ) -> Float64[Tensor, "hypotheses modes contacts contacts"]:
        """Return the gains' covariance over s^2, the noise included."""
        width, remainder, _ = rows_of(_EVERY if hypotheses is None else hypotheses)
        part = torch.tensor(REMAINDERS, dtype=torch.float64)[remainder, None, None, None]
        shapes = self.sites.shapes
        elastic = torch.einsum("ck,mwk,dk->wmcd", shapes, self.scaled_prior(modes), shapes)
        both = (1.0 - part) * elastic[width] + part * self.sites.remainder
        return both + torch.diag_embed(self.noise(modes, hypotheses))

    def kernel(
        self,
        shapes: Float64[Tensor, "places shapes"],
        across: Float64[Tensor, "places contacts"],
        width: int,
        remainder: int,
    ) -> Float64[Tensor, "modes places contacts"]:
        """Return the covariance over s^2 of all modes' gains at places with those at the contacts, by one hypothesis.

        `shapes` as in `Sites`, `across` the smooth kernel between places and contacts; `width` and `remainder` are rows
        of the tables.
        """
        prior = self.scaled_prior(torch.arange(self.prior.shape[0]))[:, width]
        elastic = torch.einsum("pk,mk,ck->mpc", shapes, prior, self.sites.shapes)
        return (1.0 - REMAINDERS[remainder]) * elastic + REMAINDERS[remainder] * across

    def factor(
        self, modes: Int[Tensor, " modes"], hypotheses: Int[Tensor, " hypotheses"] | None = None
    ) -> Float64[Tensor, "hypotheses modes contacts contacts"]:
        """Return the lower factor of the covariance."""
        return torch.linalg.cholesky(self.covariance(modes, hypotheses))

    def solve(
        self, modes: Int[Tensor, " modes"], factor: Float64[Tensor, "hypotheses modes contacts contacts"]
    ) -> Float64[Tensor, "hypotheses modes contacts 2"]:
        """Return the gains times the inverse of the covariance of this factor."""
        return torch.cholesky_solve(self.values[:, modes].transpose(0, 1).expand(len(factor), -1, -1, -1), factor)

    def squares(
        self, modes: Int[Tensor, " modes"], solved: Float64[Tensor, "hypotheses modes contacts 2"]
    ) -> Float64[Tensor, "hypotheses modes 2"]:
        """Return the gains times what `solve` gives: over `count` it is s^2 as each hypothesis has it."""
        values = self.values[:, modes].transpose(0, 1)
        return (values * solved).sum(2).clamp_min(torch.finfo(torch.float64).tiny)

    def likelihood(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "hypotheses modes 2"]:
        """Return the log of each hypothesis's evidence, with s integrated out, up to a constant of the contacts."""
        factor = self.factor(modes)
        squares = self.squares(modes, self.solve(modes, factor))
        spread = 2.0 * torch.log(torch.diagonal(factor, dim1=-2, dim2=-1)).sum(-1)
        # What is not heard has next to no part in the squares, and its own noise alone as factor of the determinant:
        # left there, it would speak for as little noise as there is.
        spread = spread - torch.log(self.noise(modes)[..., ~self.heard]).sum(-1)
        likely = -0.5 * (self.count * torch.log(squares) + spread[..., None])
        return torch.where(self.silent[modes], 0.0, likely)
