"""From measured gains to the gain model: the weights of all kernels, and of the factors on nominal frequencies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Complex128, Float32, Float64, Int
from torch import Tensor

from avmsf.fem.updating import Matched
from avmsf.field.gains.elastic import UNRELATED, Elastic
from avmsf.field.gains.kernels import KernelFamily
from avmsf.field.gains.mixture import (
    NOISE_SHARES,
    Hypotheses,
    KernelMixture,
    log_evidence,
    log_joint,
    posterior_weights,
)
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import series_of

_ALL_NOISE = 1e12
"""Variance of the noise over the mean square of a part at most: far beyond what leaves anything of the gains."""
_NEAR = 0.3
"""Standard deviation of the log frequency of modes by which the level of one is expected."""
_SUBSTANTIAL = 1e-3
"""Part of a mode's energy from which on a part of its gains counts in learning the prior."""


@dataclass(frozen=True, eq=False)
class MeasuredGains:
    """Gains at the training contacts, and what is known of their modes."""

    values: Complex128[Tensor, "contacts modes"]
    """Turned by each mode's common phase: the real part starts with it, the imaginary one a quarter period ahead."""
    variance: Float64[Tensor, " modes"]
    """That the background noise gives each part of each gain."""
    frequency: Float64[Tensor, " modes"]
    """Hz."""
    damping: Float64[Tensor, " modes"]
    """1/s."""

    def take(self, rows: Int[Tensor, " rows"]) -> "MeasuredGains":
        """Return the gains at some of the contacts."""
        return replace(self, values=self.values[rows])

    @property
    def energy(self) -> Float64[Tensor, " modes"]:
        """Of each mode's sound, up to a constant."""
        return self.values.abs().square().sum(0) / self.damping

    @property
    def level(self) -> Float64[Tensor, " series"]:
        """The mean square that a part is expected to have by those of the informative modes near in frequency.

        Their geometric mean, without the bias of a mean of few squares; a part's own where there are none.
        """
        tiny = torch.finfo(torch.float64).tiny
        own = torch.stack([self.values.real, self.values.imag]).square().mean(1).clamp_min(tiny)
        apart = torch.log(self.frequency[:, None] / self.frequency)
        near = torch.exp(-0.5 * (apart / _NEAR).square()) * self.informative.reshape(2, -1, 1)
        total = near.sum(1)
        half = torch.tensor(0.5 * len(self.values), dtype=torch.float64)
        logs = (own.log()[:, None] @ near)[:, 0] / total.clamp_min(tiny) - torch.digamma(half) + half.log()
        return torch.where(total > 0, logs.exp(), own).flatten()

    @property
    def informative(self) -> Bool[Tensor, " series"]:
        """Which series the prior is learned from, in which every one counts alike.

        Not those of silent and doubled modes, nor parts below a thousandth of their mode's energy, which are what the
        common phase leaves of noise.
        """
        power = torch.stack([self.values.real.square().sum(0), self.values.imag.square().sum(0)])
        substantial = (power >= _SUBSTANTIAL * power.sum(0)) & self.distinct
        # Energy is more than rounding leaves of none.
        return ((power > 1e-20 * power.max()) & substantial).flatten()

    @property
    def distinct(self) -> Bool[Tensor, " modes"]:
        """Which modes are the strongest within their half-power bandwidth, the mean of damping / pi of two modes.

        Extraction may give one mode as two of nearly the same frequency, which are to count as one.
        """
        width = (self.damping[:, None] + self.damping) / (2.0 * math.pi)
        near = (self.frequency[:, None] - self.frequency).abs() < width
        order = torch.argsort(self.energy, descending=True)
        kept = torch.zeros(len(order), dtype=torch.bool)
        for row in order.tolist():
            kept[row] = not bool((kept & near[row]).any())
        return kept

    @property
    def floor(self) -> Float64[Tensor, " series"]:
        """The variance over the mean square of a part; for a mode without gains so large that its gains are noise."""
        size = self.values.abs().square().mean(0) / 2.0
        return (self.variance / size.clamp_min(torch.finfo(torch.float64).tiny)).clamp_max(_ALL_NOISE).repeat(2)


@dataclass(frozen=True, eq=False)
class WeighedFamily:
    """A family with what the gains say of its kernels."""

    family: KernelFamily
    kernels: Float64[Tensor, "kernels contacts contacts"]
    evidence: Float64[Tensor, "kernels noises series"]

    @classmethod
    def of(
        cls, family: KernelFamily, measured: MeasuredGains, noise_shares: tuple[float, ...] = NOISE_SHARES
    ) -> "WeighedFamily":
        """Return the family with its log evidence."""
        kernels = family.kernels()
        evidence = log_evidence(
            kernels, series_of(measured.values), measured.floor, noise_shares,
            expected=family.visibility()[:, None] * measured.level,
        )  # fmt: skip
        return cls(family, kernels, evidence)


def fit_mixture(
    families: Sequence[KernelFamily],
    measured: MeasuredGains,
    points: Float32[Tensor, "points 3"],
    *,
    directional: bool,
    noise_shares: tuple[float, ...] = NOISE_SHARES,
) -> MixtureGains:
    """Return the gain model of some families, all of the same reference impacts, by evidence."""
    values, floor = series_of(measured.values), measured.floor
    weighed = [WeighedFamily.of(family, measured, noise_shares) for family in families]
    weigh_factors(weighed, measured)
    evidence = torch.cat([each.evidence for each in weighed])
    weights = posterior_weights(evidence, hypotheses_of(weighed, measured), measured.informative)
    used = weights.sum((1, 2)) > 0
    kernels = torch.cat([each.kernels for each in weighed])[used]
    repetitions = families[0].reference.repetitions()
    mixture = KernelMixture(kernels, values, floor, weights[used], noise_shares, repetitions)
    rows = torch.split(used, [len(family) for family in families])
    kept = tuple(family.take(torch.nonzero(each).flatten()) for family, each in zip(families, rows, strict=True))
    return MixtureGains(points, families[0].reference, tuple(filter(len, kept)), mixture, directional)


def hypotheses_of(families: Sequence[WeighedFamily], measured: MeasuredGains) -> Hypotheses:
    """Return how probable the kernels of all families are beforehand."""
    kinds = [each.family.kind for each in families]
    category, prior, first = [], [], 0
    for each in families:
        within = each.family.category_prior()
        category.append(each.family.categories() + first)
        prior.append(each.family.prior / kinds.count(each.family.kind) * within)
        first += len(within)
    log_frequency = torch.log(measured.frequency)
    log_prior = torch.cat([each.family.log_prior(log_frequency) for each in families]).repeat(1, 2)
    return Hypotheses(torch.cat(category), torch.cat(prior), log_prior)


def total_evidence(families: Sequence[WeighedFamily], measured: MeasuredGains) -> float:
    """Return the log evidence of the gains of all modes, up to a constant of the gains, nats.

    What all modes have in common, such as an object's support, is found by this: a mixture weighs kernels for each mode
    by itself, and mixes wrong bodies where a mode has few gains.
    """
    weigh_factors(families, measured)
    evidence, active = torch.cat([each.evidence for each in families]), measured.informative
    joint = log_joint(evidence, hypotheses_of(families, measured), active)[..., active]
    return float(torch.logsumexp(joint.flatten(0, 1), dim=0).sum())


def weigh_factors(families: Sequence[WeighedFamily], measured: MeasuredGains) -> None:
    """Give each elastic family the probabilities of factors on its frequencies and of their errors.

    A mode is a perturbed shape of the body with some frequency, or no shape of it; both parts of its gains share the
    shape. Given factor and error the modes are independent of each other.
    """
    unknown, log_frequency = _no_shape(families), torch.log(measured.frequency)
    for each in families:
        if isinstance(each.family, Elastic):
            density = each.family.match(log_frequency, _shape(each, each.family) - unknown)
            either = torch.logaddexp(density, torch.zeros(()))[:, measured.distinct].sum(1)
            each.family.frequency_weights = torch.softmax(each.family.factor_log_prior + either, dim=0)


def matched(families: Sequence[WeighedFamily], elastic: Elastic, measured: MeasuredGains) -> Matched:
    """Return what gains say of a body: of its shapes and of all gains, with it among the families."""
    weighed = [*families, WeighedFamily.of(elastic, measured)]
    total, active = total_evidence(weighed, measured), measured.informative
    # Parts that say nothing of their mode's shape are left out, and each mode counts its frequency once.
    shape, prior = _shape(weighed[-1], elastic, active), elastic.shape_log_prior(torch.log(measured.frequency))
    others = torch.stack([elastic.unrelated(shape), _no_shape(families, active)])
    joined = torch.cat([prior + shape + math.log(1.0 - UNRELATED), others])
    return Matched(total, torch.softmax(joined, dim=0)[: -len(others)], math.log(elastic.factor))


def _shape(
    weighed: WeighedFamily, elastic: Elastic, active: Bool[Tensor, " series"] | float = 1.0
) -> Float64[Tensor, "shapes modes"]:
    """Return the log evidence of each shape, that of both parts."""
    return (elastic.shape_evidence(weighed.evidence) * active).reshape(len(elastic.modes), 2, -1).sum(1)


def _no_shape(
    families: Sequence[WeighedFamily], active: Bool[Tensor, " series"] | float = 1.0
) -> Float64[Tensor, " modes"]:
    """Return the log evidence that a mode is no shape of a body, that of both parts."""
    others = [each for each in families if not isinstance(each.family, Elastic)]
    total = sum(each.family.prior for each in others)
    logs = [
        each.evidence.flatten(0, 1) + math.log(each.family.prior / total / each.evidence[:, :, 0].numel())
        for each in others
    ]
    return (torch.logsumexp(torch.cat(logs), dim=0) * active).reshape(2, -1).sum(0)
