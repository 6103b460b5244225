"""Gains as Bayesian regression: what few elastic shapes near in frequency, a smooth remainder and noise can explain.

A measured mode's gains y at the contacts are one draw of a Gaussian field with the covariance

    s^2 [(1 - p) sum_k g_k phi_k(x) phi_k(x') + p r(x, x')] + s^2 q I,

where phi_k is the component of elastic shape k along the blow, r a smooth kernel, and g_k = exp(-(log f/f_k)^2 / 2 w^2)
says that a mode draws on shapes near to it in frequency. How near (w), how smooth a remainder (p) and how much noise
(q) is not known: every combination of a grid is a hypothesis, whose evidence is the likelihood of y with s integrated
out (prior 1/s). How likely a hypothesis is beforehand is learnt from all modes together, by expectation maximisation,
and the gains elsewhere are the mean over hypotheses of what each foretells. So a mode whose own few gains say little of
its noise borrows from the others (MacKay, Neural Computation 4, 1992; Tipping, JMLR 1, 2001, for the sparse forms that
were tried before).
"""

import math
from dataclasses import dataclass, replace
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
FARTHEST = 1e-3
"""Prior variance of the shapes that are not near at all, over that of the nearest."""
_ROUNDS = 5
"""Of learning how likely hypotheses are beforehand."""
_PSEUDO = 0.1
"""Modes' worth of belief, each, in that all hypotheses are alike."""
_NEGLIGIBLE = 0.01
"""Weight under which a hypothesis is dropped."""
_SILENT = 1e-20
"""Energy of gains over the strongest's, up to which they are none."""
_MEMORY = 4_000_000
"""Numbers of a batch of matrices."""


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


@dataclass(frozen=True, eq=False)
class Regression:
    """Hypotheses about each mode's gains, weighed by the gains at the contacts."""

    sites: Sites
    prior: Float64[Tensor, "modes widths shapes"]
    """Of `nearness`."""
    values: Float64[Tensor, "contacts modes 2"]
    """Gains at the contacts, in two parts that are independent of each other."""
    floor: Float64[Tensor, "contacts modes"]
    """Variance of the gains by the extraction's own error, over the gains' mean square: added to every noise."""
    doubt: Float64[Tensor, " contacts"]
    """Factor on the noise's variance, one for a contact that is trusted."""
    weights: Float64[Tensor, "hypotheses modes 2"]
    """How likely each hypothesis is after all; they sum to one."""
    evidence: float
    """Log of the likelihood of all gains, up to a constant of their number."""

    @classmethod
    def of(
        cls,
        sites: Sites,
        prior: Float64[Tensor, "modes widths shapes"],
        values: Float64[Tensor, "contacts modes 2"],
        *,
        floor: Float64[Tensor, "contacts modes"],
        doubt: Float64[Tensor, " contacts"],
    ) -> "Regression":
        """Weigh all hypotheses."""
        blank = cls(sites, prior, values, floor, doubt, values.new_zeros(0, values.shape[1], 2), 0.0)
        single = torch.cat([blank._likelihood(modes) for modes in blank._batches()], dim=1)
        joint = _with_beliefs(single)
        weights = torch.softmax(joint, dim=0)
        weights = torch.where(weights < _NEGLIGIBLE, 0.0, weights)
        return cls(
            sites, prior, values, floor, doubt, weights / weights.sum(0), float(torch.logsumexp(joint, dim=0).sum())
        )

    @classmethod
    def evidence_of(
        cls,
        sites: Sites,
        priors: Float64[Tensor, "trials modes widths shapes"],
        values: Float64[Tensor, "contacts modes 2"],
        *,
        floor: Float64[Tensor, "contacts modes"],
        doubt: Float64[Tensor, " contacts"],
    ) -> Float64[Tensor, " trials"]:
        """Return the evidence that `of` finds with each of several priors, all at once: many are soon tried."""
        trials, modes = priors.shape[:2]
        blank = cls(
            sites,
            priors.flatten(0, 1),
            values.repeat(1, trials, 1),
            floor.repeat(1, trials),
            doubt,
            values.new_zeros(0, trials * modes, 2),
            0.0,
        )
        single = torch.cat([blank._likelihood(rows) for rows in blank._batches()], dim=1)
        joint = _with_beliefs(single.reshape(len(single), trials, modes, 2).movedim(1, 0))
        return torch.logsumexp(joint, dim=-3).sum((-2, -1))

    def take(self, modes: Int[Tensor, " modes"]) -> "Regression":
        """Return the regression of the given modes, in the given order."""
        return replace(
            self,
            prior=self.prior[modes],
            values=self.values[:, modes],
            floor=self.floor[:, modes],
            weights=self.weights[:, modes],
        )

    def with_values(self, values: Float64[Tensor, "contacts modes 2"]) -> "Regression":
        """Return the same hypotheses, as likely as before, on other gains."""
        return replace(self, values=values)

    @cached_property
    def expansion(self) -> tuple[Float64[Tensor, "shapes modes 2"], Float64[Tensor, "contacts modes 2"]]:
        """Weights of the elastic shapes, and of the remainder's kernels at the contacts, in the mean gains."""
        shapes, kernels = [], []
        for modes in self._batches():
            solved = self._solved(modes)
            weighed = self.weights[:, modes].unsqueeze(2) * solved
            parts = self._grid(weighed)
            along = torch.einsum("ck,wpqmcd->wmkd", self.sites.shapes, parts * self._elastic(parts))
            shapes.append(torch.einsum("wmkd,mwk->kmd", along, self._scaled_prior(modes)))
            kernels.append(torch.einsum("wpqmcd->cmd", parts * self._smooth(parts)))
        return torch.cat(shapes, dim=1), torch.cat(kernels, dim=1)

    @cached_property
    def noise(self) -> Float64[Tensor, "contacts modes 2"]:
        """Standard error of the gains at the contacts, as the hypotheses have it."""
        found = []
        for modes in self._batches():
            scale = self._scale(modes)
            size = torch.tensor(NOISES, dtype=torch.float64).repeat(len(WIDTHS) * len(REMAINDERS))
            own = size[:, None, None] * self.doubt[:, None] + self.floor[:, modes]
            weighed = (self.weights[:, modes] * scale).unsqueeze(1) * own[..., None]
            found.append(weighed.sum(0))
        return torch.cat(found, dim=1).sqrt()

    @cached_property
    def smoother(self) -> Float64[Tensor, "modes 2 contacts contacts"]:
        """What each contact's gain counts for at each contact, in the mean gains, for each part."""
        return torch.cat([self._smoother(modes) for modes in self._batches()])

    def deviation(
        self,
        shapes: Float64[Tensor, "places shapes"],
        across: Float64[Tensor, "places contacts"],
        own: Float64[Tensor, " places"],
    ) -> Float64[Tensor, "places modes 2"]:
        """Return the standard deviation of the gains at places, given what is known of them beforehand.

        `shapes` as in `Sites`, `across` the remainder's kernel between places and contacts, `own` that of each place
        with itself. Within hypotheses and between them.
        """
        columns = []
        for mode in range(self.prior.shape[0]):
            modes = torch.tensor([mode])
            kept = torch.nonzero(self.weights[:, mode].sum(1) > 0).flatten()
            width, remainder, _ = self._named(kept)
            prior = self._scaled_prior(modes)[0][width]
            part = torch.tensor(REMAINDERS, dtype=torch.float64)[remainder]
            elastic = torch.einsum("pk,hk,ck->hpc", shapes, prior, self.sites.shapes)
            cross = (1 - part)[:, None, None] * elastic + part[:, None, None] * across
            alone = (1 - part)[:, None] * (prior @ shapes.square().T) + part[:, None] * own
            factor = torch.linalg.cholesky(self._covariance(modes)[kept, 0])
            half = torch.linalg.solve_triangular(factor, cross.mT, upper=False)
            within = (alone - half.square().sum(1)).clamp_min(0.0)
            mean = cross @ torch.cholesky_solve(self.values[:, mode].expand(len(kept), -1, -1), factor)
            weight, scale = self.weights[kept, mode], self._scale(modes)[kept, 0]
            squares = torch.einsum("hd,hpd->pd", weight, scale[:, None] * within[..., None] + mean.square())
            middle = torch.einsum("hd,hpd->pd", weight, mean)
            columns.append((squares - middle.square()).clamp_min(0.0).sqrt())
        return torch.stack(columns, dim=1)

    def posterior(
        self,
        mode: int,
        shapes: Float64[Tensor, "places shapes"],
        across: Float64[Tensor, "places contacts"],
        among: Float64[Tensor, "places places"],
    ) -> tuple[Float64[Tensor, "places places"], float]:
        """Return the covariance of one mode's gains among places, and the variance that one more blow has of its own.

        By the mode's likeliest hypothesis, both summed over the gains' two parts. `shapes` as in `Sites`, `across` the
        remainder's kernel between places and contacts, `among` between places.
        """
        modes = torch.tensor([mode])
        likeliest = int((self.weights[:, mode] * self.values[:, mode].square().sum(0)).sum(1).argmax())
        width, remainder, noise = (int(each) for each in self._named(torch.tensor([likeliest])))
        prior, part = self._scaled_prior(modes)[0, width], REMAINDERS[remainder]
        cross = (1.0 - part) * (shapes * prior) @ self.sites.shapes.T + part * across
        alone = (1.0 - part) * (shapes * prior) @ shapes.T + part * among
        half = torch.linalg.solve_triangular(
            torch.linalg.cholesky(self._covariance(modes)[likeliest, 0]), cross.T, upper=False
        )
        scale = float(self._scale(modes)[likeliest, 0].sum())
        return scale * (alone - half.T @ half), scale * (NOISES[noise] + float(self.floor[:, mode].mean()))

    @cached_property
    def left_out(self) -> tuple[Float64[Tensor, "contacts modes 2"], Float64[Tensor, "contacts modes 2"]]:
        """Return by how much each gain at a contact is missed by all others', and the deviation foretold of that.

        Hypotheses are weighed without the gain that is left out, by the same belief beforehand; the deviation is of a
        measured gain, noise and all.
        """
        found = [self._left_out(modes) for modes in self._batches()]
        return torch.cat([missed for missed, _ in found], dim=1), torch.cat([spread for _, spread in found], dim=1)

    def covariance_of(self, width: int, remainder: int, noise: int) -> Float64[Tensor, "modes contacts contacts"]:
        """Return the gains' covariance over s^2 by one hypothesis, by the rows in the tables; its noise included."""
        kernel = self.kernel(self.sites.shapes, self.sites.remainder, width, remainder)
        own = NOISES[noise] * self.doubt[:, None] + self.floor
        return kernel + torch.diag_embed(own.T)

    def kernel(
        self,
        shapes: Float64[Tensor, "places shapes"],
        across: Float64[Tensor, "places contacts"],
        width: int,
        remainder: int,
    ) -> Float64[Tensor, "modes places contacts"]:
        """Return the covariance over s^2 of the gains at places with those at the contacts, by one hypothesis."""
        prior = self._scaled_prior(torch.arange(self.prior.shape[0]))[:, width]
        elastic = torch.einsum("pk,mk,ck->mpc", shapes, prior, self.sites.shapes)
        return (1.0 - REMAINDERS[remainder]) * elastic + REMAINDERS[remainder] * across

    def _batches(self) -> tuple[Int[Tensor, " modes"], ...]:
        hypotheses, contacts = len(WIDTHS) * len(REMAINDERS) * len(NOISES), len(self.values)
        size = max(1, _MEMORY // (hypotheses * contacts**2))
        return torch.split(torch.arange(self.prior.shape[0]), size)

    def _named(self, hypotheses: Int[Tensor, " hypotheses"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the rows of each hypothesis's width, remainder and noise in their tables."""
        noise = hypotheses % len(NOISES)
        rest = hypotheses // len(NOISES)
        return rest // len(REMAINDERS), rest % len(REMAINDERS), noise

    def _grid(self, flat: Tensor) -> Tensor:
        return flat.reshape(len(WIDTHS), len(REMAINDERS), len(NOISES), *flat.shape[1:])

    def _elastic(self, like: Tensor) -> Tensor:
        return (1 - torch.tensor(REMAINDERS, dtype=torch.float64)).reshape(1, -1, *[1] * (like.ndim - 2))

    def _smooth(self, like: Tensor) -> Tensor:
        return torch.tensor(REMAINDERS, dtype=torch.float64).reshape(1, -1, *[1] * (like.ndim - 2))

    def _scaled_prior(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "modes widths shapes"]:
        """Return the prior variances, such that gains at the contacts are of mean square one."""
        prior = self.prior[modes]
        size = torch.einsum("ck,mwk->mw", self.sites.shapes.square(), prior) / len(self.values)
        return prior / size.clamp_min(torch.finfo(torch.float64).tiny)[..., None]

    def _covariance(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "hypotheses modes contacts contacts"]:
        """Return the gains' covariance over s^2, the noise included."""
        shapes = self.sites.shapes
        elastic = torch.einsum("ck,mwk,dk->wmcd", shapes, self._scaled_prior(modes), shapes)[:, None, None]
        both = self._elastic(elastic) * elastic + self._smooth(elastic) * self.sites.remainder
        size = torch.tensor(NOISES, dtype=torch.float64)[:, None, None] * self.doubt
        noise = torch.diag_embed(size + self.floor[:, modes].T)
        return (both + noise).flatten(0, 2)

    def _factor(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "hypotheses modes contacts contacts"]:
        return torch.linalg.cholesky(self._covariance(modes))

    def _solved(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "hypotheses modes contacts 2"]:
        factor = self._factor(modes)
        return torch.cholesky_solve(self.values[:, modes].transpose(0, 1).expand(len(factor), -1, -1, -1), factor)

    def _quadratic(self, modes: Int[Tensor, " modes"], solved: Tensor) -> Float64[Tensor, "hypotheses modes 2"]:
        values = self.values[:, modes].transpose(0, 1)
        return (values * solved).sum(2).clamp_min(torch.finfo(torch.float64).tiny)

    def _scale(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "hypotheses modes 2"]:
        """Return s^2 as each hypothesis has it."""
        return self._quadratic(modes, self._solved(modes)) / len(self.values)

    @cached_property
    def silent(self) -> Bool[Tensor, "modes 2"]:
        """Whether each part of each mode has no gains at all: nothing, then, tells of how they spread."""
        power = self.values.square().sum(0)
        return power <= _SILENT * power.max()

    def _likelihood(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "hypotheses modes 2"]:
        """Return the log of each hypothesis's evidence, with s integrated out."""
        factor = self._factor(modes)
        values = self.values[:, modes].transpose(0, 1).expand(len(factor), -1, -1, -1)
        squares = self._quadratic(modes, torch.cholesky_solve(values, factor))
        spread = 2.0 * torch.log(torch.diagonal(factor, dim1=-2, dim2=-1)).sum(-1)
        likely = -0.5 * (len(self.values) * torch.log(squares) + spread[..., None])
        return torch.where(self.silent[modes], 0.0, likely)

    def _smoother(self, modes: Int[Tensor, " modes"]) -> Float64[Tensor, "modes 2 contacts contacts"]:
        covariance = self._covariance(modes)
        size = torch.tensor(NOISES, dtype=torch.float64).repeat(len(WIDTHS) * len(REMAINDERS))
        noise = size[:, None, None] * self.doubt[:, None] + self.floor[:, modes]
        # Without its noise the covariance is what the field has; (C - N) C^-1 = 1 - N C^-1.
        solved = noise.transpose(1, 2)[..., None] * torch.cholesky_inverse(torch.linalg.cholesky(covariance))
        mean = torch.einsum("hmd,hmce->mdce", self.weights[:, modes], solved)
        return torch.eye(len(self.values), dtype=torch.float64) - mean

    def _left_out(self, modes: Int[Tensor, " modes"]) -> tuple[Tensor, Tensor]:
        inverse = torch.cholesky_inverse(self._factor(modes))
        alone = torch.diagonal(inverse, dim1=-2, dim2=-1)[..., None]
        solved = inverse @ self.values[:, modes].transpose(0, 1)
        count, tiny = len(self.values), torch.finfo(torch.float64).tiny
        whole = self._quadratic(modes, solved)[:, :, None]
        rest = (whole - solved.square() / alone).clamp_min(tiny)
        # A determinant without one row has the inverse's entry there as a factor.
        change = 0.5 * (count * torch.log(whole) - (count - 1) * torch.log(rest) - torch.log(alone))
        weights = torch.softmax(torch.log(self.weights[:, modes])[:, :, None] + change, dim=0)
        missed, variance = solved / alone, rest / (max(count - 1, 1) * alone)
        middle = (weights * missed).sum(0)
        spread = (weights * (variance + missed.square())).sum(0) - middle.square()
        return middle.transpose(0, 1), spread.clamp_min(tiny).sqrt().transpose(0, 1)


def _with_beliefs(
    single: Float64[Tensor, "*trials hypotheses modes 2"],
) -> Float64[Tensor, "*trials hypotheses modes 2"]:
    """Return the logs of the evidence of single modes, with how likely hypotheses are beforehand, learnt from all."""
    hypotheses, modes = single.shape[-3:-1]
    before = torch.full((hypotheses, 1, 2), -math.log(hypotheses), dtype=torch.float64)
    for _ in range(_ROUNDS):
        counts = torch.softmax(single + before, dim=-3).sum(-2, keepdim=True) + _PSEUDO * modes / hypotheses
        before = torch.log(counts / counts.sum(-3, keepdim=True))
    return single + before
