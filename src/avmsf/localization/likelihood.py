"""The likelihood of an impact at each of many points, given the modal amplitudes of its sound with their errors.

An impact at x of unknown force and polarity s, with an error t of its onset, has the amplitudes

    c = s a(x) exp(i w t) + e,     E |e|^2 = n + s^2 (v(x) + r^2 b(x)),

one complex number a mode: a(x) are the predicted gains, n is the variance of the extraction's noise, v(x) the field's
posterior variance, and r the relative error of fields and impacts beyond that, of b(x), the mean of the gains' squares
at x and over the surface. The force is integrated over, with the scale-free prior p(s) = 1 / |s| unless it is known; t
is its maximum-likelihood value; r is averaged over `RELATIVE_ERRORS` and `MORE_RELATIVE_ERRORS`, weighted by their
likelihood. An accurate field thus has a narrow posterior, and an inaccurate one a broad posterior. Errors of a field
are correlated between modes, so the likelihood is tempered where the field's errors dominate: its logarithm is
multiplied by an exponent below 1, which is smaller the less of the sound's energy the field explains (`INDEPENDENT`).
Dampings are no evidence, even of a field whose dampings vary with the contact: these only correct the gains.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Complex64, Complex128, Float32, Float64, Int64
from torch import Tensor

from avmsf.errors import LocationError
from avmsf.modal.modes import delayed_back

RELATIVE_ERRORS = (0.8, 0.15, 0.03)
"""Relative errors r of the gains for which the likelihood of every point is computed."""
MORE_RELATIVE_ERRORS = (1.6, 0.35, 0.07, 0.015)
"""More of these, for the likely points."""
INDEPENDENT = (0.25, 0.4)
"""Exponent of the tempered likelihood where a field's errors dominate: of a field that explains nothing of a sound even
at its best point, and of one that explains all of it. Chosen on plates, where the 90 % region then held nine impacts in
ten; elsewhere it held as few as four. So a field's own contacts calibrate it (`calibrate_tempering`)."""
SHIFT_DEVIATION = 2e-4
"""Standard deviation of that, seconds."""
_COARSE, _FINE = 0.9, 0.3
"""Step between the tried shifts of the onset, as phase of the sound's typical frequency in radians: at all points, and
at the preselected ones."""
_PRESELECTED = 2000
"""Number of preselected points, whose gains match best; the likelihood is computed for these."""
_NEGLIGIBLE = 40.0
"""Log likelihood below the largest from which on a point is negligible."""
_LEVEL_STEP, _LEVEL_LIMIT = 0.1, 28.0
"""Logarithms of the levels that noise is tried at: step, and limit either way. Amplitudes are in units of the largest;
their errors' variances are at least 1e-10, those expected of modes at least 1e-8 of the largest."""
_TINY = torch.finfo(torch.float32).tiny
_BATCH = 512
"""Points computed at once: few enough that their arrays stay in a processor's cache."""


@dataclass(frozen=True, eq=False)
class PredictedGains:
    """Predicted gains of impacts at points."""

    gains: Complex64[Tensor, "points modes"]
    variance: Float32[Tensor, "points modes"]
    """v(x): the field's posterior variance of the gains."""
    frequency: Float64[Tensor, " modes"]
    """Hz."""

    @cached_property
    def power(self) -> Float32[Tensor, "points modes"]:
        """Squares of the gains' magnitudes."""
        return self.gains.abs().square()

    @cached_property
    def mean_power(self) -> Float32[Tensor, " modes"]:
        """Mean of the gains' squares over the surface, nowhere zero."""
        mean = self.power.mean(0)
        return mean.clamp_min(max(1e-8 * float(mean.max()), _TINY))


@dataclass(frozen=True, eq=False)
class Force:
    """The prior of an impact's force, of either polarity. Raises LocationError for what is no finite number above 0."""

    expected: float
    """Relative to the force at which the field's rendered sounds are as loud as the recording."""
    spread_db: float = 3.0
    """Standard deviation, dB."""

    def __post_init__(self) -> None:
        for name, value in (("expected", self.expected), ("spread_db", self.spread_db)):
            if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0.0 < value < math.inf:
                wanted, advice = "one positive finite number", "leave the force out if it is not known"
                raise LocationError.expected(wanted, value, name=f"force.{name}", advice=advice)


class Likelihood:
    """The likelihood of each point, given amplitudes and the variances of their errors."""

    def __init__(
        self,
        predicted: PredictedGains,
        amplitudes: Complex128[Tensor, " modes"],
        noise: Float64[Tensor, " modes"],
        *,
        force: Force | None = None,
    ) -> None:
        # In units in which the strongest is one, so that float32 holds all squares.
        unit = float(amplitudes.abs().max())
        self.predicted, self.values, self.noise = predicted, amplitudes / unit, (noise / unit**2).float()
        self.prior = None if force is None else replace(force, expected=force.expected / unit)
        mean_power, unknown = predicted.mean_power, predicted.variance.mean(0)
        surplus = (self.values.abs().square().float() - self.noise).clamp_min(0.0)
        level = (surplus.sum() / (mean_power + unknown).sum()).clamp_min(1e-12)
        self.weights = 1.0 / (self.noise + level * (unknown + RELATIVE_ERRORS[1] ** 2 * mean_power))
        """One over the errors' variance, roughly: with these the shift is found."""
        self.force_weights = 1.0 / (self.noise + level * (mean_power + unknown))
        """By which energies are summed that give the force at which an impact's errors are taken."""
        self.sound = self.force_weights @ surplus
        """That sum of the sound's energy beyond the noise."""
        self.noise_fraction = float((self.weights * self.noise).mean())
        """Fraction of the errors' variance that is noise, 0 to 1."""
        rows = self._preselect(_PRESELECTED)
        found = self._evaluate(rows, RELATIVE_ERRORS)
        near = torch.nonzero(found[0] > found[0].max() - _NEGLIGIBLE).flatten()
        finer = self._evaluate(rows[near], MORE_RELATIVE_ERRORS)
        better = finer[0] > found[0][near]
        found[1][near[better]] = finer[1][better]
        found[0][near] = torch.logaddexp(found[0][near], finer[0])
        count, logs = len(predicted.gains), found[0].double()
        # The others are no likelier than the least likely of those.
        self.log_likelihood = torch.full((count,), float(logs.min()), dtype=torch.float64)
        """[points], up to a constant, with errors that are independent between modes."""
        self.force = torch.zeros(count, dtype=torch.float64)
        """[points], the force of greatest likelihood, with its sign; 0 at points that were not preselected."""
        self.shift = torch.zeros(count, dtype=torch.float64)
        """[points], the shift of the onset of greatest likelihood, seconds from the impact to the first sample."""
        self.log_likelihood[rows], self.force[rows], self.shift[rows] = logs, unit * found[1].double(), found[2]

    def tempering(self, explained: float, *, factor: float = 1.0) -> float:
        """Return the exponent of the tempered likelihood, where the likeliest point explains that part of the sound.

        `factor` on `INDEPENDENT` is that of one field, as `calibrate_tempering` measures it.
        """
        least, most = INDEPENDENT
        together = min(1.0, factor * (least + (most - least) * explained))
        # Noise errs in every mode by itself. Not the arithmetic mean: where modes of a field that errs tell a twentieth
        # of their number, a tenth of noise would make that a seventh.
        return together ** (1.0 - self.noise_fraction)

    def evidence(self) -> float:
        """Return the log Bayes factor of an impact at some point, all equally probable before, against noise.

        Noise is one of two, equally probable: errors of the extraction that are louder than they are taken for, or
        modes of random phase that are as strong relative to each other as the field expects on average over the
        surface. Its level has no scale, p(level) = 1 / level, as the force has none.
        """
        levels = torch.arange(-_LEVEL_LIMIT, _LEVEL_LIMIT, _LEVEL_STEP, dtype=torch.float64).exp()[:, None]
        noise, mean_power = self.noise.double(), (self.predicted.mean_power + self.predicted.variance.mean(0)).double()
        variance = torch.cat([levels * noise, noise + levels * mean_power / mean_power.mean()])
        logs = -(variance.log() + self.values.abs().square() / variance).sum(1)
        # The likelihood of a point is a sum over the relative errors, and leaves out a factor of the force's integral.
        constant = math.log(len(RELATIVE_ERRORS) + len(MORE_RELATIVE_ERRORS)) - 0.5 * math.log(math.pi)
        noise_log_likelihood = float(torch.logsumexp(logs, 0)) + math.log(_LEVEL_STEP / 2.0) + constant
        return float(self.log_likelihood.logsumexp(0)) - math.log(len(self.log_likelihood)) - noise_log_likelihood

    def _preselect(self, count: int) -> Int64[Tensor, " rows"]:
        """Return the rows, ascending, of the points whose gains match the amplitudes best, whatever the force."""
        if len(self.predicted.gains) <= count:
            return torch.arange(len(self.predicted.gains))
        _, rotated = self._rotated(_COARSE)
        match = (torch.view_as_real(self.predicted.gains).flatten(1) @ self._weighted(rotated)).abs().amax(1)
        size = (self.predicted.power @ self.weights).clamp_min(_TINY).sqrt()
        return torch.sort(torch.topk(match / size, count).indices).values

    def _rotated(self, step: float) -> tuple[Float64[Tensor, " shifts"], Complex64[Tensor, "shifts modes"]]:
        energy = self.weights.double() * self.values.abs().square()
        return delayed_back(self.values, self.predicted.frequency, power=energy, step=step)

    def _weighted(self, rotated: Complex64[Tensor, "shifts modes"]) -> Float32[Tensor, "two_modes shifts"]:
        return torch.view_as_real(rotated * self.weights).flatten(1).T.contiguous()

    def _evaluate(
        self, rows: Int64[Tensor, " rows"], relative_errors: tuple[float, ...]
    ) -> tuple[Float32[Tensor, " rows"], Float32[Tensor, " rows"], Float64[Tensor, " rows"]]:
        """Return the log likelihood, summed over relative errors, and the force and shift of the likeliest one."""
        steps, rotated = self._rotated(_FINE)
        prior = -0.5 * (steps / SHIFT_DEVIATION).square()
        weighted, energy, mean_power = self._weighted(rotated), rotated[0].abs().square(), self.predicted.mean_power
        mean = self.force_weights @ mean_power
        evidence, forces, shifts = [], [], []
        for part in torch.split(rows, _BATCH):
            gains, power = self.predicted.gains[part], self.predicted.power[part]
            match = torch.view_as_real(gains).flatten(1) @ weighted
            gained = match.square() / (power @ self.weights).clamp_min(_TINY)[:, None]
            chosen = torch.argmax(gained + prior.float(), dim=1)
            both = torch.view_as_real(gains) * torch.view_as_real(rotated[chosen])
            cross, variance = both[..., 0] + both[..., 1], self.predicted.variance[part]
            own, spread = power @ self.force_weights, variance @ self.force_weights
            tried = []
            for half in (0.5 * relative_error**2 for relative_error in relative_errors):
                error = torch.add(variance, power + mean_power, alpha=half)
                # At this force an impact, with its errors, has the sound's energy.
                squares = (self.sound / ((1.0 + half) * own + spread + half * mean).clamp_min(_TINY)).clamp(1e-24, 1e24)
                weights = error.mul_(squares[:, None]).add_(self.noise).reciprocal_()
                match, size = torch.linalg.vecdot(weights, cross), torch.linalg.vecdot(weights, power).clamp_min(_TINY)
                strength = match / size
                found = weights.log().sum(1) - weights @ energy + match * strength - 0.5 * size.log()
                tried.append((found + self._log_force_prior(strength, squares), strength))
            found, strength = (torch.stack(each) for each in zip(*tried, strict=True))
            evidence.append(torch.logsumexp(found, 0) + prior[chosen].float())
            forces.append(strength.gather(0, found.argmax(0)[None])[0])
            shifts.append(steps[chosen])
        return torch.cat(evidence), torch.cat(forces), torch.cat(shifts)

    def _log_force_prior(
        self, strength: Float32[Tensor, " rows"], squares: Float32[Tensor, " rows"]
    ) -> Float32[Tensor, " rows"]:
        """Return the logarithm of a force's prior, at the force that fits best or the square of the errors' force."""
        if self.prior is None:
            return -0.5 * squares.log()
        size = strength.abs().clamp_min(_TINY)
        spread = self.prior.spread_db * math.log(10.0) / 20.0
        return -size.log() - 0.5 * ((size / self.prior.expected).log() / spread).square()
