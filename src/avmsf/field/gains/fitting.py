"""From measured gains to the gain model: the weights of all kernels, and of the factors on nominal frequencies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex128, Float32, Float64
from torch import Tensor

from avmsf.field.gains.elastic import Elastic, factor_log_prior
from avmsf.field.gains.family import KernelFamily
from avmsf.field.gains.mixture import NOISE_SHARES, Hypotheses, KernelMixture, active_series, log_evidence
from avmsf.field.gains.model import MixtureGains, series_of

_STRONGEST = 16
"""Modes of the most energy, which decide on the factor on nominal frequencies: many weak ones are not the body's."""
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

    @property
    def energy(self) -> Float64[Tensor, " modes"]:
        """Of each mode's sound, up to a constant."""
        return self.values.abs().square().sum(0) / self.damping

    @property
    def substantial(self) -> Bool[Tensor, " series"]:
        """Which parts have a thousandth of their mode's energy: smaller ones are what the common phase leaves of noise.

        They have no part in learning the prior, in which every series counts alike.
        """
        power = torch.stack([self.values.real.square().sum(0), self.values.imag.square().sum(0)])
        return (power >= _SUBSTANTIAL * power.sum(0)).flatten()

    @property
    def floor(self) -> Float64[Tensor, " series"]:
        """The variance over the mean square of a part; finite for a mode without gains too."""
        size, limits = self.values.abs().square().mean(0) / 2.0, torch.finfo(torch.float64)
        return (self.variance / size.clamp_min(limits.tiny)).clamp_max(limits.max).repeat(2)


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
    kernels = [family.kernels() for family in families]
    evidence = [log_evidence(each, values, floor, noise_shares) for each in kernels]
    pairs = list(zip(families, evidence, strict=True))
    weigh_factors(pairs, measured)
    kinds = [family.kind for family in families]
    category, prior, first = [], [], 0
    for family in families:
        own = family.categories() + first
        count = int(own.max()) + 1 - first
        category.append(own)
        prior.append(torch.full((count,), family.prior / kinds.count(family.kind) / count, dtype=torch.float64))
        first += count
    log_frequency = torch.log(measured.frequency)
    log_prior = torch.cat([family.log_prior(log_frequency) for family in families]).repeat(1, 2)
    hypotheses = Hypotheses(torch.cat(kernels), torch.cat(category), torch.cat(prior), log_prior)
    active = active_series(values) & measured.substantial
    mixture, used = KernelMixture.weigh(
        hypotheses, torch.cat(evidence), values, floor, active=active, noise_shares=noise_shares
    )
    ends = torch.tensor([len(family.shares) for family in families]).cumsum(0).tolist()
    starts = [0, *ends[:-1]]
    rows = [used[(used >= start) & (used < end)] - start for start, end in zip(starts, ends, strict=True)]
    some = [(family, each) for family, each in zip(families, rows, strict=True) if len(each)]
    kept_families, kept = zip(*some, strict=True)
    return MixtureGains(points, families[0].reference, kept_families, kept, mixture, directional)


def total_evidence(families: Sequence[KernelFamily], measured: MeasuredGains) -> float:
    """Return the log evidence of the gains of all modes, up to a constant of the gains, nats.

    What all modes have in common, such as an object's support, is found by this: a mixture weighs kernels for each mode
    by itself, and mixes wrong bodies where a mode has few gains. Probabilities within families are not learned.
    """
    values, floor = series_of(measured.values), measured.floor
    evidence = [log_evidence(family.kernels(), values, floor, NOISE_SHARES) for family in families]
    weigh_factors(list(zip(families, evidence, strict=True)), measured)
    log_frequency = torch.log(measured.frequency)
    terms = []
    for family, each in zip(families, evidence, strict=True):
        categories = int(family.categories().max()) + 1
        prior = family.log_prior(log_frequency).repeat(1, 2) + math.log(family.prior / categories / each.shape[1])
        terms.append((each + prior[:, None]).flatten(0, 1))
    active = active_series(values) & measured.substantial
    return float(torch.logsumexp(torch.cat(terms), dim=0)[active].sum())


def weigh_factors(families: Sequence[tuple[KernelFamily, Tensor]], measured: MeasuredGains) -> None:
    """Give each elastic family the probabilities of the factors on its frequencies, from the strongest modes.

    A mode is a perturbed shape of the body with some frequency, or no shape of it; both parts of its gains share the
    shape. Given a factor the modes are independent of each other.
    """
    others = [(family, each) for family, each in families if not isinstance(family, Elastic)]
    total = sum(family.prior for family, _ in others)
    none = torch.cat(
        [each.flatten(0, 1) + math.log(family.prior / total / each[:, :, 0].numel()) for family, each in others]
    )
    unknown = torch.logsumexp(none, dim=0).reshape(2, -1).sum(0)
    rows = torch.topk(measured.energy, min(_STRONGEST, len(measured.energy))).indices
    for family, each in families:
        if isinstance(family, Elastic):
            known = family.shape_evidence(each).reshape(len(family.modes), 2, -1).sum(1)
            single = torch.logsumexp(family.match(torch.log(measured.frequency)) + known, dim=1)
            both = torch.logaddexp(single, unknown)[:, rows]
            family.factor_weights = torch.softmax(both.sum(1) + factor_log_prior(), dim=0)
