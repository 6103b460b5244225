"""How much better each contact's gains are predicted with places than without: the log predictive ratio.

For contact i, given contacts S that are set aside, the leave-one-out log predictive ratio is

    L_i(S) = sum_s w_s [log p(y_is | y_Rs, places) - log p(y_is | y_Rs, no places)],

R being all contacts but S and i; the sum is over all series (each part of each mode's gains), w_s being the mode's
share of the energy. Both densities are Student t with as many degrees of freedom as R has contacts, the scale
integrated out (`mixture`); without places gains are independent of each other. So L_i > 0 where the other contacts'
gains and places predict contact i, and L_i < 0 where its gains are less probable there than anywhere. In closed form,
with n contacts in all (R and i), P = C^-1 of them, a = P y and Q = y' a,

    log p(y_i | y_R) = -n/2 log Q + (n-1)/2 log(Q - a_i^2 / P_ii) + 1/2 log P_ii + constant of n

(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2), and without j as well

    P_ii -> P_ii - P_ij^2 / P_jj,   a_i -> a_i - P_ij a_j / P_jj,   Q -> Q - a_j^2 / P_jj.

Standardized leave-one-out errors do not serve: those of the kernels' misfit are as large as a wrong label's, while the
ratio to gains without places measures both on one scale.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from avmsf.field.gains.family import KernelFamily, Sites
from avmsf.field.gains.fitting import MeasuredGains
from avmsf.field.gains.model import MixtureGains, series_of

_TINY = torch.finfo(torch.float64).tiny


@dataclass(frozen=True, eq=False)
class PredictiveRatios:
    """Log predictive ratios of contacts under one hypothesis for each series, its most probable one."""

    model: MixtureGains
    """Fitted to some of the contacts; gives the hypotheses."""
    sites: Sites
    """All contacts."""
    measured: MeasuredGains
    """Gains at all contacts."""

    @cached_property
    def values(self) -> Float64[Tensor, "contacts series"]:
        """Both parts of the gains."""
        return series_of(self.measured.values)

    @cached_property
    def weight(self) -> Float64[Tensor, " series"]:
        """Each mode's share of the energy, for both its parts."""
        return (self.measured.energy / self.measured.energy.sum().clamp_min(_TINY)).repeat(2)

    @cached_property
    def covariance(self) -> Float64[Tensor, "series contacts contacts"]:
        """C of each series between all contacts, noise included."""
        noise = self._noise[:, None, None] * torch.eye(len(self.sites), dtype=torch.float64)
        return self._kernels(self.sites, self.sites) + noise

    def without(
        self, aside: frozenset[int]
    ) -> tuple[Float64[Tensor, " contacts"], Float64[Tensor, "contacts contacts"]]:
        """Return L_i(S), and L_i(S and j) [i, j]; NaN for contacts in S and for i = j."""
        rows = self._rest(aside)
        values, inverse, solved, quadratic = self._solved(rows)
        own, power = torch.diagonal(inverse, dim1=1, dim2=2), values.square().sum(1)
        known = _log_student(solved / own, 1.0 / own, quadratic[:, None], len(rows))
        single = self.weight @ (known - _log_student(values, torch.ones(()), power[:, None], len(rows)))
        shared = inverse / own[:, None]
        variance = 1.0 / (own[..., None] - shared * inverse).clamp_min(_TINY)
        error = (solved[..., None] - shared * solved[:, None]) * variance
        known = _log_student(error, variance, (quadratic[:, None] - solved.square() / own)[:, None], len(rows) - 1)
        less = (power[:, None] - values.square())[:, None]
        unknown = _log_student(values[..., None], torch.ones(()), less, len(rows) - 1)
        pairs = torch.einsum("s,scd->cd", self.weight, known - unknown).fill_diagonal_(torch.nan)
        found = torch.full((len(self.values), len(self.values) + 1), torch.nan, dtype=torch.float64)
        found[rows, -1] = single
        found[rows[:, None], rows] = pairs
        return found[:, -1], found[:, :-1]

    def elsewhere(self, row: int, aside: frozenset[int], places: Sites) -> Float64[Tensor, "2 places"]:
        """Return the ratio of a contact if it had another site, and if it had the opposite direction there."""
        rows = self._rest(aside | {row})
        values, inverse, solved, quadratic = self._solved(rows)
        cross, gain = self._kernels(places, self.sites.take(rows)), self.values[row][:, None]
        mean = (cross @ solved[..., None])[..., 0]
        variance = self._own(places) + self._noise[:, None] - ((cross @ inverse) * cross).sum(2)
        power = values.square().sum(1, keepdim=True)
        nowhere = _log_student(gain, torch.ones(()), power + gain.square(), len(rows) + 1)
        found = []
        for error in (gain - mean, gain + mean):
            whole = quadratic[:, None] + error.square() / variance
            found.append(self.weight @ (_log_student(error, variance, whole, len(rows) + 1) - nowhere))
        return torch.stack(found)

    def _rest(self, aside: frozenset[int]) -> Int[Tensor, " rows"]:
        return torch.tensor([row for row in range(len(self.sites)) if row not in aside])

    def _solved(self, rows: Int[Tensor, " rows"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return y [series, rows], P [series, rows, rows], P y [series, rows] and y' P y [series] of some contacts."""
        values = self.values[rows].T
        inverse = torch.linalg.inv(self.covariance[:, rows[:, None], rows])
        solved = (inverse @ values[..., None])[..., 0]
        return values, inverse, solved, (solved * values).sum(1)

    @cached_property
    def _best(self) -> Int[Tensor, " series"]:
        return self.model.mixture.weights.flatten(0, 1).argmax(0)

    @cached_property
    def _noise(self) -> Float64[Tensor, " series"]:
        variance = self.model.mixture.noise_variance
        return variance.gather(0, (self._best % len(variance))[None])[0]

    def _kernels(self, sites: Sites, others: Sites) -> Float64[Tensor, "series sites others"]:
        return self._each(lambda family, rows: family.between(sites, others, rows))

    def _own(self, sites: Sites) -> Float64[Tensor, "series sites"]:
        return self._each(lambda family, rows: family.own(sites, rows))

    def _each(self, kernels: Callable[[KernelFamily, Int[Tensor, " rows"]], Tensor]) -> Tensor:
        """Return what each series's most probable kernel gives."""
        used, series = torch.unique(self._best // len(self.model.mixture.noise_shares), return_inverse=True)
        found, first = [], 0
        for family, kept in zip(self.model.families, self.model.kept, strict=True):
            own = used[(used >= first) & (used < first + len(kept))] - first
            first += len(kept)
            if len(own):
                found.append(kernels(family, kept[own]))
        return torch.cat(found)[series]


def _log_student(error: Tensor, variance: Tensor, whole: Tensor, count: int) -> Tensor:
    """Return the log density of one of `count` values given the others, up to a constant of their number.

    `whole` is y' C^-1 y of all of them, error and variance (over the scale) those of the prediction from the others.
    """
    rest = (whole - error.square() / variance).clamp_min(_TINY)
    return -0.5 * (count * whole.clamp_min(_TINY).log() - (count - 1) * rest.log() + variance.log())
