"""Gaussian process regression averaged over kernels and noise shares by their evidence: the mathematics alone.

A series is one real function of the contacts, here one part of a mode's gains. Given a kernel K (contacts x contacts,
mean diagonal one) and a noise share q, the values y of a series are

    y ~ N(0, s^2 C),   C = K + v I,   v = q + floor,

where floor is the variance that the estimation of the gains is known to have, over the gains' mean square. With
K = U diag(lambda) U' and z = U' y,

    Q = y' C^-1 y = sum_i z_i^2 / (lambda_i + v),   log|C| = sum_i log(lambda_i + v),

so one eigendecomposition of each kernel serves all noise shares and all series. With the prior 1/s on the scale the
evidence is, up to a constant of the number n of contacts (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, chapter 5; the scale integrated out),

    log p(y | K, q) = -n/2 log Q - 1/2 log|C|,

and a value at a new place, with k its covariances with the contacts and k0 its own variance, is Student t with n
degrees of freedom, location k' C^-1 y and squared scale Q/n (k0 - k' C^-1 k).

Where the mean square E that the values should have if a kernel is true is known beforehand, up to a factor, s^2 has an
inverse-gamma prior of shape a and scale a E in place of 1/s, which adds to the log evidence, up to a constant of n,

    a log E - (n/2 + a) log(Q + 2 a E) + n/2 log Q.

It decides with few contacts: with one, the evidence above is the same for all kernels. Only the weights of kernels take
it; predictions given a kernel, and their variances, keep the scale of the values alone.

How probable a kernel is beforehand is learned from all series by expectation maximization: kernels come in categories,
whose probabilities maximize the summed evidence with a pseudo-count. Within a category the prior may differ from series
to series. So a series whose few values say little borrows from the others (MacKay, Neural Computation 4, 1992).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

NOISE_SHARES = (0.003, 0.01, 0.03)
"""Variances of the noise over the gains' mean square. Larger shares are left out: with few contacts that lie far apart
evidence takes what it cannot predict for noise, and smooths through clean gains."""
SCALE_SHAPE = 1.0
"""Shape a of the prior of s^2: its logarithm has a standard deviation of 1.3, so levels one of 5.6 dB. Chosen on
simulated objects with 1 to 8 impacts, one of them of sim-20 (docs/decisions/few-impacts.md)."""
_ROUNDS = 5
"""Of expectation maximization."""
_PSEUDO_COUNT = 0.1
"""Series' worth of belief in the prior of categories, for each series."""
_NEGLIGIBLE = 1e-2
"""Posterior probability, over the most probable one's of a series, below which a hypothesis is dropped. Not an absolute
one: few contacts leave thousands of hypotheses almost equally probable."""
_MEMORY = 4_000_000
"""Numbers held at once in a batch of kernels."""
_TOGETHER = 64
"""Kernels whose predictions are one product."""
_TINY = torch.finfo(torch.float64).tiny


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Kernels and how probable each is before any gain is known."""

    kernels: Float64[Tensor, "kernels contacts contacts"]
    """Symmetric and positive semidefinite, mean diagonal one."""
    category: Int[Tensor, " kernels"]
    """Row of `category_prior`; kernels of one category share a probability that is learned."""
    category_prior: Float64[Tensor, " categories"]
    """Probability of each category, summing to one."""
    log_prior: Float64[Tensor, "kernels series"]
    """Log probability of each kernel within its category, for each series."""


@dataclass(frozen=True, eq=False)
class KernelMixture:
    """The posterior of all series: kernels with their weights."""

    kernels: Float64[Tensor, "kernels contacts contacts"]
    values: Float64[Tensor, "contacts series"]
    floor: Float64[Tensor, " series"]
    """Known variance of the values over their mean square, added to every noise share."""
    weights: Float64[Tensor, "kernels noises series"]
    """Posterior probability of each kernel with each noise share; they sum to one for each series."""
    noise_shares: tuple[float, ...] = NOISE_SHARES

    @classmethod
    def weigh(
        cls,
        hypotheses: Hypotheses,
        evidence: Float64[Tensor, "kernels noises series"],
        values: Float64[Tensor, "contacts series"],
        floor: Float64[Tensor, " series"],
        *,
        active: Bool[Tensor, " series"],
        noise_shares: tuple[float, ...] = NOISE_SHARES,
    ) -> tuple["KernelMixture", Int[Tensor, " kept"]]:
        """Return the posterior and the rows of the hypotheses' kernels that it kept, from their `log_evidence`.

        The prior is learned from the `active` series alone.
        """
        weights = posterior_weights(evidence, hypotheses, active)
        kept = torch.nonzero(weights.sum((1, 2)) > 0).flatten()
        return cls(hypotheses.kernels[kept], values, floor, weights[kept], noise_shares), kept

    def with_values(self, values: Float64[Tensor, "contacts series"]) -> "KernelMixture":
        """Return the same hypotheses with the same weights, for other values."""
        return replace(self, values=values)

    def take(self, series: Int[Tensor, " series"]) -> "KernelMixture":
        """Return the posterior of some series, in the given order."""
        return replace(self, values=self.values[:, series], floor=self.floor[series], weights=self.weights[..., series])

    def at_contacts(self, contacts: Int[Tensor, " contacts"]) -> "KernelMixture":
        """Return the same hypotheses with the same weights, for the values of some of the contacts alone."""
        kernels = self.kernels[:, contacts[:, None], contacts]
        return replace(self, kernels=kernels, values=self.values[contacts])

    @cached_property
    def noise_variance(self) -> Float64[Tensor, "noises series"]:
        """The variance v of the noise over s^2."""
        return torch.tensor(self.noise_shares, dtype=torch.float64)[:, None] + self.floor

    @cached_property
    def eigen(self) -> tuple[Float64[Tensor, "kernels contacts"], Float64[Tensor, "kernels contacts contacts"]]:
        """Eigenvalues and eigenvectors of the kernels."""
        return _eigen(self.kernels)

    @cached_property
    def projected(self) -> Float64[Tensor, "kernels contacts series"]:
        """The values along the eigenvectors, z = U' y."""
        return self.eigen[1].mT @ self.values

    @cached_property
    def quadratic(self) -> Float64[Tensor, "kernels noises series"]:
        """Q = y' C^-1 y; over the number of contacts it is s^2."""
        return torch.stack([(self.projected.square() * inverse).sum(1) for inverse in self._inverses()], dim=1)

    def solve(self) -> Float64[Tensor, "kernels contacts series"]:
        """Return the sum over noise shares of weight times C^-1 y: a mean at a place is k' times it, over kernels."""
        return self.eigen[1] @ self._averaged[0]

    def standard_error(self) -> Float64[Tensor, " series"]:
        """Return the standard deviation of the noise in each value."""
        scale = self.quadratic / len(self.values)
        return (self.weights * scale * self.noise_variance).sum((0, 1)).sqrt()

    def smoother(self) -> Float64[Tensor, "series contacts contacts"]:
        """Return the matrix of each series by which the mean at the contacts is linear in the values there."""
        values, vectors = self.eigen
        shrunk = torch.zeros_like(self.projected)
        for row, inverse in enumerate(self._inverses()):
            shrunk += self.weights[:, row, None] * values[..., None] * inverse
        found = [
            torch.einsum("hcn,hn,hdn->cd", vectors, shrunk[..., series], vectors)
            for series in range(self.values.shape[1])
        ]
        return torch.stack(found)

    def leave_out(
        self, groups: Int[Tensor, " contacts"]
    ) -> tuple[Float64[Tensor, "contacts series"], Float64[Tensor, "contacts series"]]:
        """Return the mean of each value given the values of all other groups, and its standard deviation.

        Contacts of the same number in `groups` are left out together. With B the block of C^-1 of a group's rows, the
        group's error is e = B^-1 (C^-1 y) and its covariance given the others s^2 B^-1 (Rasmussen and Williams, 2006,
        equations 5.10 to 5.12, for blocks). Without the group's k values the quadratic form is Q - (C^-1 y)' e, and the
        evidence changes by n/2 log Q - (n-k)/2 log(Q - (C^-1 y)' e) - 1/2 log|B|: the hypotheses are weighed again by
        the other groups' values alone, with the same prior. What the prior of the scale says of all values stays. The
        deviation is that of a measured value, noise included.
        """
        mean, deviation = torch.empty_like(self.values), torch.empty_like(self.values)
        for group in torch.unique(groups).tolist():
            rows = torch.nonzero(groups == group).flatten()
            weights, error, variance = self._left_out(rows)
            middle = torch.einsum("hqs,hqks->ks", weights, error)
            square = torch.einsum("hqs,hqks->ks", weights, variance + error.square())
            mean[rows] = self.values[rows] - middle
            deviation[rows] = (square - middle.square()).clamp_min(_TINY).sqrt()
        return mean, deviation

    def _left_out(self, rows: Int[Tensor, " rows"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the weights without the rows' values, and each hypothesis's errors and variances of these.

        The shapes are (kernels, noises, series), and twice (kernels, noises, rows, series).
        """
        count, left = len(self.values), max(len(self.values) - len(rows), 1)
        along = self.eigen[1][:, rows]
        logs, errors, variances = [], [], []
        for noise, inverse in enumerate(self._inverses()):
            solved = torch.einsum("hkn,hns->hsk", along, self.projected * inverse)
            block = torch.einsum("hkn,hns,hln->hskl", along, inverse, along)
            covariance = torch.linalg.inv(block)
            error = torch.einsum("hskl,hsl->hsk", covariance, solved)
            quadratic = self.quadratic[:, noise].clamp_min(_TINY)
            rest = (quadratic - (error * solved).sum(2)).clamp_min(_TINY)
            change = count * quadratic.log() - left * rest.log() - torch.logdet(block)
            logs.append(self.weights[:, noise].log() + 0.5 * change)
            errors.append(error.mT)
            variances.append((rest[..., None] / left * torch.diagonal(covariance, dim1=2, dim2=3)).mT)
        joint = torch.stack(logs, dim=1)
        weights = torch.softmax(joint.flatten(0, 1), dim=0).reshape(joint.shape)
        return weights, torch.stack(errors, dim=1), torch.stack(variances, dim=1)

    def spread(
        self, cross: Float64[Tensor, "kernels places contacts"], own: Float64[Tensor, "kernels places"]
    ) -> Float64[Tensor, "places series"]:
        """Return the standard deviation at places, within hypotheses and between them, without noise.

        `cross` holds each kernel's covariances between places and contacts, `own` its variance at each place.
        """
        scale = (self.weights * self.quadratic).sum(1) / len(self.values)
        square = own.mT @ scale
        mean = torch.zeros_like(square)
        for row, (series, weights, solved) in enumerate(self._weighted):
            along = cross[row] @ self.eigen[1][row]
            mean.addmm_(along, self._averaged[0][row])
            square.index_add_(1, series, (along @ solved).square_().mul_(weights))
            square.addmm_(along.square_(), self._averaged[1][row], alpha=-1.0)
        return (square - mean.square()).clamp_min(0.0).sqrt()

    def mean_magnitude(self, cross: Float64[Tensor, "kernels places contacts"]) -> Float64[Tensor, "places series"]:
        """Return the mean over hypotheses of the magnitude of each one's mean at places; `cross` as in `spread`."""
        found = torch.zeros(cross.shape[1], self.values.shape[1], dtype=torch.float64)
        for rows, series, weights, solved in self._padded:
            each = (cross[rows] @ solved).abs_().mul_(weights[:, None])
            found.index_add_(1, series.flatten(), each.transpose(0, 1).flatten(1))
        return found

    @cached_property
    def _averaged(self) -> tuple[Tensor, Tensor]:
        """The sums over noise shares of weight times U' C^-1 y, and of weight times s^2 / (lambda + v).

        Both have the shape (kernels, contacts, series).
        """
        solved, reduced = torch.zeros_like(self.projected), torch.zeros_like(self.projected)
        for row, inverse in enumerate(self._inverses()):
            weights = self.weights[:, row, None]
            solved += weights * inverse * self.projected
            reduced += weights * self.quadratic[:, row, None] / len(self.values) * inverse
        return solved, reduced

    @cached_property
    def _weighted(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """For each kernel the series and the weights above zero, and U' C^-1 y of each of these (contacts, pairs)."""
        values, found = self.eigen[0], []
        for row, weights in enumerate(self.weights):
            noise, series = torch.nonzero(weights, as_tuple=True)
            variance = values[row][:, None] + self.noise_variance[noise, series]
            found.append((series, weights[noise, series], self.projected[row][:, series] / variance))
        return found

    @cached_property
    def _padded(self) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Rows of some kernels, and their part of `_weighted` with C^-1 y for U' C^-1 y (kernels, contacts, pairs).

        Kernels with about as many pairs are together; those with fewer are filled with weights of zero.
        """
        found = []
        order = sorted(range(len(self.weights)), key=lambda row: len(self._weighted[row][0]))
        for rows in torch.split(torch.tensor(order), _TOGETHER):
            series, weights, solved = zip(*(self._weighted[row] for row in rows.tolist()), strict=True)
            full = pad_sequence([each.T for each in solved], batch_first=True).mT
            which, weighed = (pad_sequence(list(each), batch_first=True) for each in (series, weights))
            found.append((rows, which, weighed, self.eigen[1][rows] @ full))
        return found

    def _inverses(self) -> Iterator[Float64[Tensor, "kernels contacts series"]]:
        """Yield 1 / (lambda + v) for each noise share."""
        for noise in self.noise_variance:
            yield 1.0 / (self.eigen[0][..., None] + noise)


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
                found[rows, row] += _scale_evidence(quadratic, expected[rows], len(values))
    return found


def _scale_evidence(
    quadratic: Float64[Tensor, "kernels series"], expected: Float64[Tensor, "kernels series"], count: int
) -> Float64[Tensor, "kernels series"]:
    """Return what an inverse-gamma prior of s^2 adds to the log evidence of the prior 1/s, up to a constant."""
    known = 2.0 * SCALE_SHAPE * expected.clamp_min(_TINY)
    total = (quadratic + known).log()
    return SCALE_SHAPE * (known.log() - total) - 0.5 * count * (total - quadratic.log())


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


def active_series(values: Float64[Tensor, "contacts series"]) -> Bool[Tensor, " series"]:
    """Return which series have any energy, over the strongest's: more than rounding leaves of none."""
    power = values.square().sum(0)
    return power > 1e-20 * power.max()


def _eigen(kernels: Float64[Tensor, "kernels contacts contacts"]) -> tuple[Tensor, Tensor]:
    """Return eigenvalues, none negative, and eigenvectors."""
    values, vectors = torch.linalg.eigh(kernels)
    return values.clamp_min(0.0), vectors
