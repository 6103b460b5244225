"""Gaussian process regression averaged over kernels and noise shares by their evidence: the mathematics alone.

A series is one real function of the contacts, here one part of a mode's gains. Given a kernel K (contacts x contacts,
mean diagonal one) and a noise share q, its values are

    y ~ N(0, s^2 C),   C = K + v I,   v = q + floor,

where floor is the variance that the estimation of the gains is known to have, over the gains' mean square. The scale
has the prior 1/s and is integrated out. With K = U diag(lambda) U', z = U' y and n contacts, up to a constant of n,

    Q = y' C^-1 y = sum_i z_i^2 / (lambda_i + v),   log p(y | K, q) = -n/2 log Q - 1/2 sum_i log(lambda_i + v)

(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapter 5), so that one eigendecomposition of a
kernel serves all noise shares and series. A value at a new place, with k its covariances with the contacts and k0 its
own variance, is Student t with n degrees of freedom, location k' C^-1 y and squared scale Q/n (k0 - k' C^-1 k). Where
places have repeated recordings, Q and n in this scale are those of the places' means if these make it larger
(`KernelMixture.scale`).

Where the mean square E of the values is expected beforehand, up to a factor, s^2 has an inverse-gamma prior of shape a
and scale a E in place of 1/s: with few contacts it decides. It adds to the log evidence, and to the weights of kernels
alone,

    a log E - (n/2 + a) log(Q + 2 a E) + n/2 log Q.

How probable a kernel is beforehand is learned from all series by expectation maximization: kernels come in categories,
whose probabilities maximize the summed evidence with a pseudo-count. Within a category the prior may differ from series
to series. So a series whose few values say little borrows from the others (MacKay, Neural Computation 4, 1992).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int
from scipy.optimize import minimize
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

NOISE_SHARES = (0.003, 0.01, 0.03)
"""Variances of the noise over the gains' mean square. Larger shares are left out: with few contacts that lie far apart
evidence takes what it cannot predict for noise, and smooths through clean gains."""
SCALE_SHAPE = 1.0
"""Shape a of the prior of s^2: its logarithm has a standard deviation of 1.3, so levels one of 5.6 dB. Chosen on
simulated objects with 1 to 8 impacts, one of them of sim-20 (docs/decisions/few-impacts.md)."""
LEVEL_DEVIATION = 0.36
"""Prior standard deviation of the logarithm of an impact's force: 3.2 dB, that of 74 impacts by hand on an aircraft."""
_ROUNDS = 5
"""Of expectation maximization."""
_PSEUDO_COUNT = 0.1
"""Weight of the prior of categories, in series, for each series."""
_NEGLIGIBLE = 1e-2
"""Posterior probability, over the most probable one's of a series, below which a hypothesis is dropped. Not an absolute
one: few contacts leave thousands of hypotheses almost equally probable."""
_MEMORY = 4_000_000
"""Numbers held at once in a batch of kernels."""
_TOGETHER = 64
"""Kernels whose predictions are one product."""
_TINY = torch.finfo(torch.float64).tiny

Statistic = Callable[[Float64[Tensor, "some pairs places"], Float64[Tensor, "some pairs places"]], Tensor]
"""Of normal values, from their means and variances."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """How probable each kernel is before any gain is known."""

    category: Int[Tensor, " kernels"]
    """Row of `category_prior`; kernels of one category share a probability that is learned."""
    category_prior: Float64[Tensor, " categories"]
    """Probability of each category, summing to one."""
    log_prior: Float64[Tensor, "kernels series"]
    """Log probability of each kernel within its category, for each series."""


class _Pairs(NamedTuple):
    """Hypotheses, each of one series: a kernel and a noise share."""

    kernel: Int[Tensor, " pairs"]
    series: Int[Tensor, " pairs"]
    weight: Float64[Tensor, " pairs"]
    variance: Float64[Tensor, " pairs"]
    """v."""
    inverse: Float64[Tensor, "pairs contacts"]
    """1 / (lambda + v)."""
    solved: Float64[Tensor, "pairs contacts"]
    """U' C^-1 y."""
    quadratic: Float64[Tensor, " pairs"]
    """Q."""
    scale: Float64[Tensor, " pairs"]
    """s^2."""

    def take(self, rows: Int[Tensor, " rows"] | slice) -> "_Pairs":
        return _Pairs(*(each[rows] for each in self))


class Predictions(NamedTuple):
    """Values as those of other contacts predict them."""

    mean: Float64[Tensor, "contacts series"]
    deviation: Float64[Tensor, "contacts series"]
    """Standard deviation of a measured value, noise included."""
    of_means: Float64[Tensor, "contacts series"]
    """Mean over hypotheses of the magnitude of each one's mean."""
    magnitude: Float64[Tensor, "contacts series"]
    """Mean magnitude of the value without noise."""


@dataclass(frozen=True, eq=False)
class KernelMixture:
    """The posterior of all series: kernels with their weights."""

    kernels: Float64[Tensor, "kernels contacts contacts"]
    """Symmetric and positive semidefinite, mean diagonal one."""
    values: Float64[Tensor, "contacts series"]
    floor: Float64[Tensor, " series"]
    """Known variance of the values over their mean square, added to every noise share."""
    weights: Float64[Tensor, "kernels noises series"]
    """Posterior probability of each kernel with each noise share; they sum to one for each series."""
    noise_shares: tuple[float, ...] = NOISE_SHARES
    repetitions: Int[Tensor, " contacts"] | None = None
    """A number for each contact, the same for repeated recordings (`Sites.repetitions`); None where there are none."""

    def take(self, series: Int[Tensor, " series"]) -> "KernelMixture":
        """Return the posterior of some series, in the given order."""
        return replace(self, values=self.values[:, series], floor=self.floor[series], weights=self.weights[..., series])

    @cached_property
    def noise_variance(self) -> Float64[Tensor, "noises series"]:
        """The variance v of the noise over s^2."""
        return torch.tensor(self.noise_shares, dtype=torch.float64)[:, None] + self.floor

    @cached_property
    def eigen(self) -> tuple[Float64[Tensor, "kernels contacts"], Float64[Tensor, "kernels contacts contacts"]]:
        """Eigenvalues and eigenvectors of the kernels."""
        return _eigen(self.kernels)

    def scale(
        self,
        quadratic: Float64[Tensor, " pairs"],
        variance: Float64[Tensor, " pairs"] | float,
        series: Int[Tensor, " pairs"],
        rows: Int[Tensor, " rows"],
    ) -> Float64[Tensor, " pairs"]:
        """Return s^2 by the values of some contacts, of which Q and v are given: Q over the number of places.

        What repeated recordings add to Q, their squares about the mean of their place over v, tells the noise alone.
        It is mostly less than v, and would make s^2 smaller with every repetition. Where places are not met to the
        point, the squares may be of the gains' own changes: s^2 is never less than Q over the number of contacts.
        """
        values, places = self.values[rows], rows if self.repetitions is None else self.repetitions[rows]
        member = (places[:, None] == torch.unique(places)).double()
        within = (values - member @ (member.T @ values / member.sum(0)[:, None])).square().sum(0)
        by_place = (quadratic - within[series] / variance) / max(member.shape[1], 1)
        return torch.maximum(by_place, quadratic / max(len(rows), 1))

    def standard_error(self) -> Float64[Tensor, " series"]:
        """Return the standard deviation of the noise in each value."""
        return self._summed(self._pairs.weight * self._pairs.scale * self._pairs.variance).sqrt()

    def smoother(self) -> Float64[Tensor, "series contacts contacts"]:
        """Return the matrix of each series by which the mean at the contacts is linear in the values there."""
        found = []
        for series in range(self.values.shape[1]):
            pairs = self._pairs.take(torch.nonzero(self._pairs.series == series).flatten())
            values, vectors = (each[pairs.kernel] for each in self.eigen)
            shrunk = pairs.weight[:, None] * values * pairs.inverse
            found.append(torch.einsum("pcn,pdn->cd", vectors * shrunk[:, None], vectors))
        return torch.stack(found)

    def levels(self) -> Float64[Tensor, " contacts"]:
        """Return the most probable factors of the contacts, each on the values of all series there.

        The log evidence of values divided by factors exp(t) is that of the quotients less t for each value, and t is
        normal with `LEVEL_DEVIATION`. Kernels and noise shares keep the prior that their weights were made with. The
        factor of a contact without any values is one.
        """
        pairs, (count, series) = self._pairs, self.values.shape
        prior = pairs.weight.log() + 0.5 * count * pairs.quadratic.log()
        nonzero = series * self.values.any(1).double()

        def cost(factors: np.ndarray) -> tuple[float, np.ndarray]:
            logs = torch.from_numpy(factors).requires_grad_()
            projected = (self.eigen[1].mT @ (self.values * torch.exp(-logs)[:, None]))[pairs.kernel, :, pairs.series]
            joint = prior - 0.5 * count * (projected.square() * pairs.inverse).sum(1).log()
            highest = torch.full((series,), -torch.inf, dtype=torch.float64)
            highest.scatter_reduce_(0, pairs.series, joint.detach(), "amax")
            evidence = highest + self._summed((joint - highest[pairs.series]).exp()).log()
            off = 0.5 * (logs / LEVEL_DEVIATION).square().sum() + nonzero @ logs - evidence.sum()
            return float(off.detach()), torch.autograd.grad(off, logs)[0].numpy()

        return torch.from_numpy(np.exp(minimize(cost, np.zeros(count), jac=True, method="L-BFGS-B").x))

    def leave_out(self, groups: Int[Tensor, " contacts"]) -> Predictions:
        """Return what the values of all other groups predict of each value.

        Contacts of the same number in `groups` are left out together. With B the block of C^-1 of a group's rows, the
        group's error is e = B^-1 (C^-1 y) and its covariance given the others s^2 B^-1 (Rasmussen and Williams, 2006,
        equations 5.10 to 5.12, for blocks). Without the group's k values the quadratic form is Q - (C^-1 y)' e, and the
        evidence changes by n/2 log Q - (n-k)/2 log(Q - (C^-1 y)' e) - 1/2 log|B|: the hypotheses are weighed again by
        the other groups' values alone, with the same prior. What the prior of the scale says of all values stays.
        """
        found = Predictions(*(torch.empty_like(self.values) for _ in Predictions._fields))
        series = self._pairs.series
        for group in torch.unique(groups).tolist():
            rows = torch.nonzero(groups == group).flatten()
            weights, error, variance, noise = self._left_out(rows)
            location = self.values[rows].T[series] - error
            middle = self._summed(weights[:, None] * error)
            square = self._summed(weights[:, None] * (variance + noise[:, None] + error.square()))
            found.mean[rows] = self.values[rows] - middle.T
            found.deviation[rows] = (square - middle.square()).clamp_min(_TINY).sqrt().T
            found.of_means[rows] = self._summed(weights[:, None] * location.abs()).T
            found.magnitude[rows] = self._summed(weights[:, None] * mean_magnitude(location, variance)).T
        return found

    def _left_out(self, rows: Int[Tensor, " rows"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return of the `_pairs` without the rows' values: weight, error and variance of these, and noise variance."""
        count, left, pairs = len(self.values), max(len(self.values) - len(rows), 1), self._pairs
        along = self.eigen[1][pairs.kernel[:, None], rows]
        solved = torch.einsum("pkn,pn->pk", along, pairs.solved)
        block = (along * pairs.inverse[:, None]) @ along.mT
        covariance = torch.linalg.inv(block)
        error = torch.einsum("pkl,pl->pk", covariance, solved)
        rest = (pairs.quadratic - (error * solved).sum(1)).clamp_min(_TINY)
        change = count * pairs.quadratic.clamp_min(_TINY).log() - left * rest.log() - torch.logdet(block)
        logs = pairs.weight.log() + 0.5 * change
        highest = torch.full((self.values.shape[1],), -torch.inf, dtype=torch.float64)
        highest.scatter_reduce_(0, pairs.series, logs, "amax")
        weights = (logs - highest[pairs.series]).exp()
        weights = weights / self._summed(weights)[pairs.series]
        others = torch.ones(count, dtype=torch.bool).index_fill(0, rows, False).nonzero().flatten()
        scale = self.scale(rest, pairs.variance, pairs.series, others)
        own = torch.diagonal(covariance, dim1=1, dim2=2)
        variance = scale[:, None] * (own - pairs.variance[:, None]).clamp_min(0.0)
        return weights, error, variance, scale * pairs.variance

    def average(
        self,
        cross: Float64[Tensor, "kernels places contacts"],
        own: Float64[Tensor, "kernels places"],
        *statistics: Statistic,
    ) -> list[Float64[Tensor, "places series"]]:
        """Return the means over hypotheses of statistics of the values at places, without noise.

        `cross` holds each kernel's covariances between places and contacts, `own` its variance at each place.
        """
        found = [torch.zeros(self.values.shape[1], cross.shape[1], dtype=torch.float64) for _ in statistics]
        for rows, pairs in self._padded:
            along = (cross[rows] @ self.eigen[1][rows]).mT
            mean = pairs.solved @ along
            variance = pairs.scale[..., None] * (own[rows][:, None] - pairs.inverse @ along.square())
            for total, statistic in zip(found, statistics, strict=True):
                values = pairs.weight[..., None] * statistic(mean, variance)
                total.index_add_(0, pairs.series.flatten(), values.flatten(0, 1))
        return [each.T for each in found]

    @cached_property
    def _pairs(self) -> "_Pairs":
        """The hypotheses of weight above zero of each series, by kernel: of many only a few have one."""
        kernel, noise, series = torch.nonzero(self.weights, as_tuple=True)
        variance = self.noise_variance[noise, series]
        inverse = 1.0 / (self.eigen[0][kernel] + variance[:, None])
        projected = (self.eigen[1].mT @ self.values)[kernel, :, series]
        quadratic = (projected.square() * inverse).sum(1)
        weight = self.weights[kernel, noise, series]
        scale = self.scale(quadratic, variance, series, torch.arange(len(self.values)))
        return _Pairs(kernel, series, weight, variance, inverse, projected * inverse, quadratic, scale)

    def _summed(self, values: Float64[Tensor, "pairs *rest"]) -> Float64[Tensor, "series *rest"]:
        """Return the sum over each series' `_pairs`."""
        total = torch.zeros(self.values.shape[1], *values.shape[1:], dtype=torch.float64)
        return total.index_add_(0, self._pairs.series, values)

    @cached_property
    def _padded(self) -> list[tuple[Tensor, "_Pairs"]]:
        """Rows of kernels of about as many `_pairs`, and these, [kernels, pairs], filled with weights of zero."""
        counts = torch.bincount(self._pairs.kernel, minlength=len(self.kernels))
        by_kernel = list(zip(*(torch.split(part, counts.tolist()) for part in self._pairs), strict=True))
        found = []
        for rows in torch.split(torch.argsort(counts, stable=True), _TOGETHER):
            parts = zip(*(by_kernel[row] for row in rows.tolist()), strict=True)
            found.append((rows, _Pairs(*(pad_sequence(list(part), batch_first=True) for part in parts))))
        return found


def log_evidence(
    kernels: Float64[Tensor, "kernels contacts contacts"],
    values: Float64[Tensor, "contacts series"],
    floor: Float64[Tensor, " series"],
    noise_shares: tuple[float, ...] = NOISE_SHARES,
    *,
    expected: Float64[Tensor, "kernels series"] | None = None,
) -> Float64[Tensor, "kernels noises series"]:
    """Return the log evidence of each kernel with each noise share, up to a constant of the number of contacts.

    `expected` is the mean square that the values have if a kernel is true, as far as it is known beforehand.
    """
    noises = torch.tensor(noise_shares, dtype=torch.float64)[:, None] + floor
    found = torch.empty(len(kernels), len(noises), values.shape[1], dtype=torch.float64)
    size = max(1, _MEMORY // (len(values) * max(len(values), values.shape[1])))
    for rows in torch.split(torch.arange(len(kernels)), size):
        eigenvalues, vectors = _eigen(kernels[rows])
        power = (vectors.mT @ values).square()
        for row, noise in enumerate(noises):
            variance = eigenvalues[..., None] + noise
            quadratic = (power / variance).sum(1).clamp_min(_TINY)
            found[rows, row] = -0.5 * (len(values) * quadratic.log() + variance.log().sum(1))
            if expected is not None:
                known = 2.0 * SCALE_SHAPE * expected[rows].clamp_min(_TINY)
                total = (quadratic + known).log()
                found[rows, row] += SCALE_SHAPE * (known.log() - total) - 0.5 * len(values) * (total - quadratic.log())
    return found


def log_joint(
    likelihood: Float64[Tensor, "kernels noises series"], hypotheses: Hypotheses, active: Bool[Tensor, " series"]
) -> Float64[Tensor, "kernels noises series"]:
    """Return the log evidence of each hypothesis times its prior, that of categories learned.

    Each pair of a category and a noise share has a probability of its own.
    """
    noises = likelihood.shape[1]
    joint = (likelihood + hypotheses.log_prior[:, None]).flatten(0, 1)
    category = (hypotheses.category[:, None] * noises + torch.arange(noises)).flatten()
    start = (hypotheses.category_prior / hypotheses.category_prior.sum() / noises).repeat_interleave(noises)
    learned, used = start, joint[:, active]
    for _ in range(_ROUNDS if used.shape[1] else 0):
        weights = torch.softmax(used + learned.log()[category, None], dim=0)
        counts = _PSEUDO_COUNT * used.shape[1] * start
        counts = counts.index_add(0, category, weights.sum(1))
        learned = counts / counts.sum()
    return (joint + learned.log()[category, None]).reshape(likelihood.shape)


def posterior_weights(
    likelihood: Float64[Tensor, "kernels noises series"], hypotheses: Hypotheses, active: Bool[Tensor, " series"]
) -> Float64[Tensor, "kernels noises series"]:
    """Return the posterior probabilities, negligible ones as zero, with the prior of categories learned."""
    joint = log_joint(likelihood, hypotheses, active)
    weights = torch.softmax(joint.flatten(0, 1), dim=0)
    weights = torch.where(weights < _NEGLIGIBLE * weights.amax(0), 0.0, weights)
    return (weights / weights.sum(0)).reshape(joint.shape)


def mean_magnitude(mean: Float64[Tensor, "*shape"], variance: Float64[Tensor, "*shape"]) -> Float64[Tensor, "*shape"]:
    """Return the mean of the magnitude of normal variables: that of the folded normal distribution."""
    deviation = variance.clamp_min(0.0).sqrt()
    scaled = mean / deviation.clamp_min(_TINY)
    around = deviation * math.sqrt(2.0 / math.pi) * torch.exp(-0.5 * scaled.square())
    return around + mean * torch.erf(scaled * math.sqrt(0.5))


def _eigen(kernels: Float64[Tensor, "kernels contacts contacts"]) -> tuple[Tensor, Tensor]:
    """Return eigenvalues, none negative, and eigenvectors."""
    values, vectors = torch.linalg.eigh(kernels)
    return values.clamp_min(0.0), vectors
