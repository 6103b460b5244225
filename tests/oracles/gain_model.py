"""The page "Gain models" formula by formula: explicit matrices, loops, one series and one hypothesis at a time.

Its values are numpy arrays; `kernel` is a covariance between contacts, `variance` the noise's over the scale.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

Array = NDArray[np.float64]

NORMAL = norm.ppf((np.arange(20_000) + 0.5) / 20_000)
"""Equally probable values of a standard normal variable."""


class Prediction(NamedTuple):
    """What one hypothesis or several predict at some places."""

    mean: Array
    deviation: Array
    of_means: Array
    """Mean over hypotheses of the magnitude of each one's mean."""
    magnitude: Array
    """Mean magnitude without noise, by equally probable draws."""


def log_evidence(kernel: Array, variance: float, values: Array) -> float:
    """Return log of the integral of N(values; 0, s^2 C) ds / s, up to a constant of the number of values."""
    covariance = kernel + variance * np.eye(len(values))
    quadratic = values @ np.linalg.inv(covariance) @ values
    return -0.5 * len(values) * np.log(quadratic) - 0.5 * np.linalg.slogdet(covariance)[1]


def integrated_log_evidence(
    kernel: Array, variance: float, values: Array, log_prior: Callable[[Array], Array], span: tuple[float, float]
) -> float:
    """Return log of the integral of N(values; 0, s^2 C) p(log s^2) over log s^2 within a span, by trapezoids.

    They converge exponentially for a function that vanishes at both ends.
    """
    logs = np.linspace(*span, 20_001)
    covariance = kernel + variance * np.eye(len(values))
    quadratic = values @ np.linalg.inv(covariance) @ values
    normal = -0.5 * len(values) * logs - 0.5 * quadratic * np.exp(-logs) - 0.5 * np.linalg.slogdet(covariance)[1]
    return float(np.log(np.trapezoid(np.exp(normal + log_prior(logs)), logs)))


def conditional(
    kernel: Array, variance: float, values: Array, places: Array | None = None
) -> tuple[Array, Array, float]:
    """Return mean and covariance of the places that follow the known contacts in a joint kernel, and s^2.

    Contacts of one number in `places` are repeated impacts, which tell the scale as one does.
    """
    count = len(values)
    inverse = np.linalg.inv(kernel[:count, :count] + variance * np.eye(count))
    own = [values[[row]] for row in range(count)] if places is None else [values[places == each] for each in {*places}]
    within = sum(((each - each.mean()) ** 2).sum() for each in own)
    quadratic = values @ inverse @ values - (within / variance if within else 0.0)
    across, scale = kernel[count:, :count], max(quadratic / len(own), values @ inverse @ values / count)
    return across @ inverse @ values, scale * (kernel[count:, count:] - across @ inverse @ across.T), float(scale)


def averaged(
    kernels: Sequence[Array], variances: Sequence[float], weights: Sequence[float], values: Array, *, noise: bool
) -> Prediction:
    """Return what hypotheses of some weights predict together; `noise`: whether the deviation includes it."""
    mean, square, of_means, magnitude = np.zeros((4, len(kernels[0]) - len(values)))
    for kernel, variance, weight in zip(kernels, variances, weights, strict=True):
        location, covariance, scale = conditional(kernel, variance, values)
        within = np.diag(covariance)
        mean += weight * location
        square += weight * (within + scale * variance * noise + location**2)
        of_means += weight * np.abs(location)
        magnitude += weight * np.abs(location + np.sqrt(within.clip(0.0)) * NORMAL[:, None]).mean(0)
    return Prediction(mean, np.sqrt(square - mean**2), of_means, magnitude)


def learned_prior(joint: Array, category: Sequence[int], start: Array, *, rounds: int, pseudo_count: float) -> Array:
    """Return the probability of each category and noise share, learned by expectation maximization.

    `joint` [kernels, noises, series] is the log evidence times the prior within a category, `start` [categories,
    noises] sums to one. Each round counts how probable each hypothesis is in each series.
    """
    learned = start
    for _ in range(rounds):
        counts = pseudo_count * joint.shape[2] * start
        for series in range(joint.shape[2]):
            weights = np.exp(joint[..., series] - joint[..., series].max()) * learned[list(category)]
            for kernel, weight in zip(category, weights / weights.sum(), strict=True):
                counts[kernel] += weight
        learned = counts / counts.sum()
    return learned


def log_predictive_ratio(kernel: Array, variance: float, values: Array) -> float:
    """Return the log density of the last value given the others, over that if gains are independent: Student's t."""
    known, value = values[:-1], values[-1]
    mean, covariance, scale = conditional(kernel, variance, known)
    placed = t.logpdf(value, len(known), mean[0], np.sqrt(covariance[0, 0] + scale * variance))
    return float(placed - t.logpdf(value, len(known), 0.0, np.sqrt((known**2).mean())))


def expected_level(values: Array, frequency: Array, counted: Array, *, width: float) -> Array:
    """Return the geometric mean square of the counted modes near each mode, without the bias of few squares.

    `values` [contacts, modes] are one part of the gains. The log of a mean of n squares of normal variables is off by
    digamma(n / 2) - log(n / 2) on average, here by as many draws as it takes.
    """
    draws = np.random.default_rng(0).chisquare(len(values), 2_000_000) / len(values)
    bias = np.log(draws).mean()
    found = []
    for mode in frequency:
        near = np.exp(-0.5 * (np.log(frequency / mode) / width) ** 2) * counted
        found.append(np.exp((near * np.log((values**2).mean(0))).sum() / near.sum() - bias))
    return np.array(found)
