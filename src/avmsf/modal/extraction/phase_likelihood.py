"""The likelihood of recordings' delays: phases of modes about those of the other recordings (see `alignment`)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank

_MAX_CANDIDATES = 8
"""Highest peaks of the density among which a delay is chosen."""
_MAX_NEWTON_STEPS = 8
"""Of each search, at most one grid step long each."""
_CONVERGED_SAMPLES = 1e-6
"""They end earlier where all delays move by less than this, samples."""
_GRID_STEPS_PER_PERIOD = 10
"""Grid points in half a period of the highest mode, after which its doubled phase repeats."""
_RELATIVE_ERROR = 0.05
"""Error across the phase of any amplitude, over the amplitude: frequencies and dampings are never exact."""
_OUTLIER_SHARE = 0.2
"""Part of the phases that lie anywhere: of modes that are hardly excited, or that two close modes are taken for. And of
the recordings with wide spreads."""
_USUAL_SPREAD = 0.05
"""Spread of a mode of which little is known: phases to .2 rad."""
FIRST_SPREAD = 0.25
"""The spread of a mode before anything is known of it: half of what phases without a mean would have."""
_WIDE_RATIO = 4.0
"""A recording's own spread over that of most, if it is one of the part that is wide: of close modes that a contact
excites differently the phases are others there."""
_MEDIAN_OF_SQUARE = 0.455
"""Median of the square of a standard normal number."""


PerContact = Float64[Tensor, " contacts"]
PerMode = Float64[Tensor, " modes"]
Weights = Float64[Tensor, "contacts modes"]
Phasors = Complex128[Tensor, "contacts modes"]


@dataclass(frozen=True, eq=False)
class DelayPrior:
    """Delays have Cauchy distributions about these middles."""

    middle: Float64[Tensor, " #contacts"]
    """Samples; one where all have the same."""
    scale: float
    """Median distance from it, samples."""

    def log_density(self, delays: Float64[Tensor, "*steps #contacts"]) -> Float64[Tensor, "*steps contacts"]:
        """Return the logarithm of the density, per sample."""
        return -torch.log1p(((delays - self.middle) / self.scale).square()) - math.log(math.pi * self.scale)

    def slope(self, delays: PerContact) -> PerContact:
        """Return the derivative of the log density."""
        away = delays - self.middle
        return -2 * away / (self.scale**2 + away.square())

    def median(self, delays: PerContact, probability: PerContact) -> PerContact:
        """Return the median of what are these delays with a probability, and else distributed as here."""
        away = delays - self.middle
        # The quantile of a Cauchy distribution; its tangent has a pole where the probability is a half.
        part = (probability / (1 - probability)).nan_to_num(1.0).clamp_max(1.0)
        farthest = self.scale * torch.tan(0.5 * math.pi * part).abs()
        return self.middle + torch.where(part < 1, away.sign() * torch.minimum(away.abs(), farthest), away)


class MeasuredPhases:
    """The modes' amplitudes in each recording, and what a delay makes of their phases."""

    def __init__(
        self, impacts: Impacts, bank: ModalBank, *, reach: float, background: Weights, power: PerMode | None = None
    ) -> None:
        """Measure them, to be aligned by delays of at most `reach` samples.

        `background` is the noise's power at each mode (`background_power`), `power` the modes' mean power in all
        recordings, each of unit energy, if it is known from others than these.
        """
        rate, samples = impacts.sample_rate, impacts.sounds.shape[1]
        self.bank, self.exponent = bank, torch.complex(-bank.damping, 2 * math.pi * bank.frequency) / rate
        self.amplitude = -1j * fit_gains(impacts.sounds.double(), bank, sample_rate=rate)
        """Of exp((-d + 2 pi i f) t), [contacts, modes], in the recordings' unit."""
        scale = (self.amplitude.abs().square() / bank.damping).sum(1, keepdim=True).sqrt()
        scale = scale.clamp_min(torch.finfo(torch.float32).tiny)
        # The squared samples of exp(-d t) cos(2 pi f t) add up to this.
        energy = rate * -torch.expm1(-2 * bank.damping * samples / rate) / (4 * bank.damping)
        self.noise = background / energy / scale.square()
        """Variance across its phase that the background noise makes of an amplitude, each recording of unit energy in
        the modes, so that loud ones count no more than weak ones."""
        scaled = self.amplitude / scale
        self.phase, self.squares = scaled.angle(), scaled.abs().square()
        self.power = self.squares.mean(0) if power is None else power
        self.step = min(0.5, rate / (2 * _GRID_STEPS_PER_PERIOD * float(bank.frequency.max())))
        steps = math.ceil(reach / self.step)
        self.grid = self.step * torch.arange(-steps, steps + 1, dtype=torch.float64)
        """Delays that are searched, samples."""
        self.turn = 4 * math.pi * bank.frequency / rate
        """Radians by which a delay of one sample turns a doubled phase."""
        angles = self.turn[:, None] * self.grid
        # By these the delays of the grid turn the real and the imaginary parts of doubled phases.
        self.table = torch.cat([angles.cos(), -angles.sin()]).float()

    def __len__(self) -> int:
        return len(self.amplitude)

    def variance(self, spread: Float64[Tensor, "*#contacts modes"]) -> Weights:
        """Return the variance across the phase."""
        shared = spread * torch.sqrt(self.squares * self.power)
        return (self.noise + shared + _RELATIVE_ERROR**2 * self.squares).clamp_min(torch.finfo(torch.float64).tiny)

    def concentration(self, spread: Float64[Tensor, "*#contacts modes"]) -> Weights:
        """Return the concentrations of the doubled phases."""
        return self.squares / (4 * self.variance(spread))

    def delayed_amplitude(self, delays: PerContact) -> Phasors:
        """Return the amplitudes with each recording starting later by its delay, samples."""
        return self.amplitude * torch.exp(self.exponent * delays[:, None])

    def doubled(self, delays: PerContact) -> Phasors:
        """Return exp(2 i phase) with each recording starting later by its delay."""
        return torch.exp(1j * (2 * self.phase + self.turn * delays[:, None]))

    def spread(self, weights: Weights, delays: PerContact, *, vague: float) -> PerMode:
        """Return the spread of each mode's amplitudes about its mean phase, by the median over recordings.

        Averaged with the usual one, which counts as `vague` recordings.
        """
        turned = self.doubled(delays)
        mean = (weights * turned).sum(0)
        across = self.squares * (1 - (turned * torch.exp(-1j * mean.angle())).real) / 2
        size = torch.sqrt(self.squares * self.power).clamp_min(torch.finfo(torch.float64).tiny)
        found = (across / size).median(0).values / _MEDIAN_OF_SQUARE
        return (len(self) * found + vague * _USUAL_SPREAD) / (len(self) + vague)

    def log_likelihood(
        self, weights: Weights, spread: Float64[Tensor, "*#contacts modes"], doubled: Complex128[Tensor, " modes"]
    ) -> float:
        """Return the log likelihood of the amplitudes' parts across their phases, all mean phases alike."""
        normal = -0.5 * torch.log(self.variance(spread)) - weights
        return float(normal.sum() + log_i0(doubled.abs()).sum())

    def search(self, spread: PerMode, doubled: Phasors, prior: DelayPrior) -> tuple[PerContact, PerContact, Weights]:
        """Return each recording's likeliest delay, the log odds that its phases agree with `doubled`, and its spread.

        `doubled` is the sum of the others' weights times exp(2 i phase), for each recording. The odds compare phases
        about these, over all delays of the prior and both spreads, with phases that are anything.
        """
        spreads = torch.stack([spread, torch.maximum(spread, (_WIDE_RATIO * spread).clamp_max(FIRST_SPREAD))])
        found = [self._search(self.concentration(each), doubled, prior) for each in spreads]
        delays, odds = (torch.stack(each) for each in zip(*found, strict=True))
        odds = odds + torch.tensor([[1 - _OUTLIER_SHARE], [_OUTLIER_SHARE]], dtype=torch.float64).log()
        best = odds.argmax(0)
        return delays.gather(0, best[None])[0], odds.logsumexp(0), spreads[best]

    def _search(self, weights: Weights, doubled: Phasors, prior: DelayPrior) -> tuple[PerContact, PerContact]:
        strength = doubled.abs()
        # The others' mean phase is not known exactly: two von Mises laws in a row have about the product of the means'
        # lengths.
        pull = weights * torch.special.i1e(strength) / torch.special.i0e(strength)
        toward, level = pull * torch.exp(1j * (2 * self.phase - doubled.angle())), log_i0(pull)
        candidates = self._candidates(toward, prior)
        turned = toward[:, None] * torch.exp(1j * self.turn * candidates[:, :, None])
        robust = _log_odds(_inlier_odds(turned, level[:, None])) + prior.log_density(candidates.T).T
        delays = candidates.gather(1, robust.argmax(1, keepdim=True))[:, 0]

        def derivatives() -> tuple[Tensor, Tensor, Tensor]:
            turned = toward * torch.exp(1j * self.turn * delays[:, None])
            odds = _inlier_odds(turned, level)
            likely = turned * (odds / (odds + _OUTLIER_SHARE))
            return odds, -(self.turn * likely.imag).sum(1), (self.turn.square() * likely.real).sum(1)

        for _ in range(_MAX_NEWTON_STEPS):
            _, slope, bend = derivatives()
            step = torch.where(bend > 0, (prior.slope(delays) + slope) / bend, 0.0).clamp(-self.step, self.step)
            delays = delays + step
            if float(step.abs().max()) < _CONVERGED_SAMPLES:
                break
        odds, _, bend = derivatives()
        return delays, _log_odds(odds) + occam_factor(prior, delays, bend)

    def _candidates(self, toward: Phasors, prior: DelayPrior) -> Float64[Tensor, "contacts candidates"]:
        """Return delays of the grid at which the product of the densities is highest, in single precision."""
        away = (self.grid - prior.middle[:, None]).float() / prior.scale
        parts = torch.cat([toward.real, toward.imag], dim=1).float()
        score = torch.addmm(torch.log1p(away.square()), parts, self.table, beta=-1)
        rises = torch.nn.functional.pad(score[:, 1:] >= score[:, :-1], (1, 0), value=True)
        falls = torch.nn.functional.pad(score[:, :-1] >= score[:, 1:], (0, 1), value=True)
        peaks = torch.where(rises & falls, score, -math.inf)
        return self.grid[torch.topk(peaks, min(_MAX_CANDIDATES, len(self.grid)), dim=1).indices]


def _inlier_odds(
    toward: Complex128[Tensor, "*delays modes"], level: Float64[Tensor, "*#delays modes"]
) -> Float64[Tensor, "*delays modes"]:
    """Return the density of phases that lie about the others' mean, over that of phases anywhere, times their share.

    `toward` is the concentration times exp(2 i error), `level` the concentration's `log_i0`.
    """
    return (1 - _OUTLIER_SHARE) * (toward.real - level).exp()


def _log_odds(inlier_odds: Float64[Tensor, "*delays modes"]) -> Float64[Tensor, "*delays"]:
    """Return the log odds that all phases lie about the others' mean, but for the usual outliers, against anywhere."""
    return torch.log(_OUTLIER_SHARE + inlier_odds).sum(-1)


def occam_factor(prior: DelayPrior, delays: PerContact, bend: PerContact) -> PerContact:
    """Return what not knowing the delays costs: their prior density times the width of their posterior (Laplace).

    `bend` is the second derivative of the log likelihood, negated. Nothing is won by delays that are not known at all.
    """
    width = 0.5 * torch.log(2 * math.pi / bend.clamp_min(1e-300))
    return (prior.log_density(delays) + width).clamp_max(0.0)


def log_i0(value: Float64[Tensor, "..."]) -> Float64[Tensor, "..."]:
    """Return the logarithm of the modified Bessel function I0, which itself overflows above 700."""
    return torch.special.i0e(value).log() + value
