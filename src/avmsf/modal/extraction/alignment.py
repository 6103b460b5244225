"""Joint time alignment: one delay a recording, so that each mode has one phase, modulo pi, in all of them.

An onset that is found in one recording alone is off by a few samples, and so the phase of a mode differs from recording
to recording. The poles do not depend on delays, and a delay of tau seconds turns mode m's complex amplitude c_im by
exp((-d_m + 2 pi i f_m) tau). A fixed sensor and a short impact give each mode one phase p_m, up to the sign of the
mode's shape at the contact, so that doubled phases agree over recordings:

    2 arg c_im + 4 pi f_m tau_i = 2 p_m + error,  errors about zero with concentration k_im (von Mises).

With a flat prior of p_m and a Cauchy prior of tau_i, which favors small delays and allows long ones, the logarithm of
the posterior of the delays is

    sum_m log I0(|z_m|) - sum_i log(1 + (tau_i / s)^2),  z_m = sum_i k_im exp(2 i arg c_im + 4 pi i f_m tau_i),

which is climbed one recording at a time: given the others' z_m, a recording's delay is searched on a grid and refined
by Newton's method. The concentration is that of a Gaussian error across the phase: k = |c|^2 / (4 v), where the
variance v adds the noise, a part that grows with the mode's amplitude at this contact and at all contacts alike
(neighboring modes leak into each other), estimated from the median error of each mode, and a small relative part; a
few recordings have wider errors than most. A recording whose phases agree with the others' at no delay is moved as
most are: its delay is the median of a posterior that mixes both, by the probability of agreement. Of
several starting recordings, each of which the others are first aligned with, the one of highest posterior counts.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Complex128
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf._utils.tensor_files import TensorReader
from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.finders import HighResolution
from avmsf.modal.extraction.phase_likelihood import (
    FIRST_SPREAD,
    DelayPrior,
    MeasuredPhases,
    PerContact,
    PerMode,
    Phasors,
    occam_factor,
)
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import background_power
from avmsf.modal.spectra import with_length

_MIN_SEARCHED_RECORDINGS, _MIN_SEARCHED_SAMPLES = 32, 1_400_000
"""Modes are looked for in so many recordings, or in as many as hold so many samples together, whichever is more. Where
this leaves recordings out the delays differ by less than .02 samples."""
_MAX_REFERENCES = 6
"""Recordings to start from in turn, the most energetic in their modes first."""
_MAX_ROUNDS = 40
"""Most passes over all recordings."""
_MAX_JITTER_SAMPLES = 2.0
"""Scale of the delays before anything is known of them, samples: what a threshold of a tenth of the peak leaves."""
_LAST_REACH_SAMPLES = 1.0
"""Longest delay of the last search, samples."""
_STILL_LOG_ODDS = 3.0
"""Log odds, per recording, of no delays at all where every file starts with its impact, as impulse responses do:
without common phases delays gain up to 2.5, files trimmed 1 to 2 samples apart 6 to 25."""
_USUAL_RECORDINGS = 2.0
"""Recordings of the usual spread that a mode's own is mixed with: of few, some modes agree by chance."""
_MIN_JITTER_SAMPLES = 0.5
"""Least scale of the delays, samples: an onset that is found at a sample is off by a part of one."""
_ROUNDS_OF_FIXED_JITTER = 4
"""Passes before the delays' own scale counts."""
_ONSET_FRACTIONS = 16
"""Places between two samples where the common start is looked for."""
_CONVERGED_SAMPLES = 1e-3
"""Samples by which delays still move when the search ends."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """How recordings were aligned with one another."""

    __repr__ = short_repr

    names: tuple[str, ...]
    delays: PerContact
    """Samples by which each sound starts later in its file than it was read."""
    agreement: PerContact
    """Probability that a recording's phases agree with the others' at some delay, rather than with none."""
    coherence_before: float
    """Coherence of the phases as read, from 0 to 1 (`coherence`)."""
    coherence_after: float
    """The same after alignment."""
    keys: tuple[str, ...]
    """What the recordings are recognized by (`recording_keys`)."""
    bank: ModalBank
    """Modes by whose phases they were aligned; with the next three others are aligned as they are."""
    doubled: Complex128[Tensor, " modes"]
    """Sum over recordings of the concentration times exp(2 i phase), at the common start."""
    power: PerMode
    """Mean over recordings of the squared amplitude, each recording scaled to unit energy in the modes."""
    spread: PerMode
    """Variance across the phase over the geometric mean of `power` and the amplitude's own square."""
    jitter: float
    """Median distance of the delays from `start`, samples."""
    start: float
    """Delay of a usual recording, their median."""

    def apply(self, impacts: Impacts) -> Impacts:
        """Return recordings cut anew at the common start: known ones by their delays, others by their phases.

        A recording that was not among those aligned is aligned alone, its phases with theirs; where they do not agree
        it is moved as most are, and no recording is where those aligned have kept their starts. Recordings that are
        final already are returned as they are.
        """
        if impacts.before is None:
            return impacts
        known = dict(zip(self.keys, self.delays.tolist(), strict=True))
        keys = recording_keys(impacts)
        delays = torch.tensor([known.get(key, 0.0) for key in keys], dtype=torch.float64)
        others = torch.tensor([row for row, key in enumerate(keys) if key not in known], dtype=torch.long)
        if len(others) and bool((self.delays != 0).any()):
            new, reach = impacts.take(others.tolist()), float(impacts.before.shape[1])
            delays[others] = self._delays_alone(new, usual=self.start, reach=reach)
            # Once more, from sounds that start where the first estimate says.
            delays[others] += self._delays_alone(new.delayed(delays[others]), usual=0.0, reach=reach)
        return impacts.delayed(delays)

    def _delays_alone(self, impacts: Impacts, *, usual: float, reach: float) -> PerContact:
        """Return the delays by which recordings agree with the phases; `usual` for one that surely does not."""
        background = background_power(impacts.sounds, self.bank, impacts.sample_rate)
        measured = MeasuredPhases(impacts, self.bank, reach=reach, background=background, power=self.power)
        prior = DelayPrior(torch.tensor([usual], dtype=torch.float64), self.jitter)
        delays, odds, _ = measured.search(self.spread, self.doubled.expand(len(impacts), -1), prior)
        return prior.median(delays, odds.sigmoid())

    def tensors(self) -> dict[str, Tensor]:
        """Return what a file holds besides the names and keys, by name; of the agreement whether it is likely."""
        numbers = [self.coherence_before, self.coherence_after, self.jitter, self.start]
        return {
            "delays": self.delays,
            "agrees": self.agreement > 0.5,
            "numbers": torch.tensor(numbers, dtype=torch.float64),
            **vars(self.bank),
            "doubled": torch.view_as_real(self.doubled),
            "power": self.power,
            "spread": self.spread,
        }

    @classmethod
    def restore(cls, read: TensorReader, names: Sequence[str], keys: Sequence[str], modes: int) -> "Alignment":
        """Return the alignment that `tensors` are of."""
        delays, agrees = read("delays", len(names)), read("agrees", len(names), dtype=torch.bool).double()
        before, after, jitter, start = read("numbers", 4).tolist()
        bank, doubled = ModalBank(read("frequency", modes), read("damping", modes)), read("doubled", modes, 2)
        known = tuple(names), delays, agrees, before, after, tuple(keys), bank
        turned = torch.view_as_complex(doubled.contiguous())
        return cls(*known, turned, read("power", modes), read("spread", modes), jitter, start)


def align(impacts: Impacts) -> Alignment | None:
    """Return the alignment of recordings with one another; None for one, for final ones, or where no mode is found.

    A delay common to all recordings cannot be known by phases: the common start is where the aligned sounds together
    leave the noise. Where every file begins within the impact it is that of the latest, so that no sound begins with
    silence of its file's making.
    """
    if impacts.before is None or len(impacts) < 2 or len(bank := strongest_modes(impacts)) == 0:
        return None
    # Nothing is before the sounds where all files start with their impacts.
    reach, has_lead = float(impacts.before.shape[1]), bool(torch.isfinite(impacts.before).any())
    background = background_power(impacts.sounds, bank, impacts.sample_rate)
    measured = MeasuredPhases(impacts, bank, reach=reach, background=background)
    before = after = coherence(measured.amplitude, bank.damping)
    fit, agreement = _with_agreement(measured, _first_fit(measured, exact=0.0 if has_lead else _STILL_LOG_ODDS))
    delays, offset = fit.delays, 0.0
    if bool((delays != 0).any()):
        # Once more, from sounds that start where the first estimate says; then closely, with the spreads found.
        for reached, vague in ((reach, _USUAL_RECORDINGS), (_LAST_REACH_SAMPLES, 0.0)):
            measured = MeasuredPhases(impacts.delayed(delays), bank, reach=reached, background=background)
            # The prior is of all that a sound has been moved by.
            climbed = _climb(measured, DelayPrior(-delays, _MAX_JITTER_SAMPLES), vague=vague)
            fit, agreement = _with_agreement(measured, climbed)
            delays = delays + fit.delays
        offset = _common_onset(impacts, delays, agreement) if has_lead else -float(delays.min())
        delays = delays + offset
        after = coherence(measured.delayed_amplitude(fit.delays + offset), bank.damping)
    # The phases are those at the recordings' common start, which moves with the offset.
    doubled = (agreement[:, None] * fit.turned).sum(0) * torch.exp(1j * offset * measured.turn)
    known = impacts.names, delays, agreement, before, after, recording_keys(impacts)
    start = float(np.quantile(delays.numpy(), 0.5, weights=agreement.numpy(), method="inverted_cdf"))
    return Alignment(*known, bank, doubled, measured.power, fit.spread, fit.prior.scale, start)


def strongest_modes(impacts: Impacts) -> ModalBank:
    """Return the modes to align by, found in some of the recordings: they are the same in all."""
    # Drawn at random: rows may be ordered by place, in which every third may lie on the same nodal lines.
    count = max(_MIN_SEARCHED_RECORDINGS, _MIN_SEARCHED_SAMPLES // impacts.sounds.shape[1])
    drawn = torch.randperm(len(impacts), generator=torch.Generator().manual_seed(0))[:count].sort().values
    # More modes cost time and hardly narrow the posterior.
    return HighResolution(modes=32, range_db=40.0).find(impacts.sounds[drawn], impacts.sample_rate)


def recording_keys(impacts: Impacts) -> tuple[str, ...]:
    """Return a digest of each recording's name and samples: another session has the same names."""
    rows = zip(impacts.names, impacts.sounds.numpy(), strict=True)
    return tuple(hashlib.sha256(name.encode() + sound.tobytes()).hexdigest() for name, sound in rows)


def coherence(amplitude: Phasors, damping: PerMode) -> float:
    """Return how well each mode's phases agree, modulo pi, over recordings: 1 where each mode has one, near 0 for none.

    The length of the sum over recordings of exp(2 i phase), added up over modes, with the weights |amplitude|^2 /
    damping: a mode's energy.
    """
    energy = amplitude.abs().square() / damping
    summed = (amplitude.square() / damping).sum(0).abs().sum()
    return float(summed / energy.sum().clamp_min(torch.finfo(torch.float64).tiny))


def _common_onset(impacts: Impacts, delays: PerContact, agreement: PerContact) -> float:
    """Return how much later than their common start aligned recordings leave the noise, all together, samples."""
    assert impacts.before is not None
    assert impacts.after is not None
    lead = impacts.before.shape[1]
    # Sounds may be shorter than what is looked at.
    held = with_length(torch.cat([impacts.sounds[:, : 3 * lead], impacts.after], dim=1), 3 * lead)
    early = replace(impacts, sounds=held, after=impacts.after[:, :0])
    fractions = torch.arange(_ONSET_FRACTIONS, dtype=torch.float64) / _ONSET_FRACTIONS
    moved = (early.delayed(delays - lead + each).sounds[:, : 2 * lead] for each in fractions)
    power = torch.stack([each.double().square() for each in moved], dim=2).flatten(1)
    mean = agreement @ (power / power.sum(1, keepdim=True).clamp_min(1e-300)) / agreement.sum()
    highest = float(mean.max())
    # Noise within 10 dB of the sounds hides all but their loudest.
    threshold = min(max(0.01 * highest, 10 * float(mean[: _ONSET_FRACTIONS * lead // 2].median())), highest)
    return float((mean >= threshold).nonzero()[0, 0]) / _ONSET_FRACTIONS - lead


@dataclass(frozen=True, eq=False)
class _Fit:
    """Delays and what they make of the modes' phases."""

    delays: PerContact
    turned: Phasors
    """Concentrations of the doubled phases times exp(2 i phase), as delayed."""
    spread: PerMode
    prior: DelayPrior
    log_posterior: float
    """Up to a constant."""


def _first_fit(measured: MeasuredPhases, *, exact: float) -> _Fit:
    """Return the likeliest of fits from several starts and of no delays, with `exact` more log odds a recording."""
    prior = DelayPrior(torch.zeros(1, dtype=torch.float64), _MAX_JITTER_SAMPLES)
    energy = measured.squares / measured.bank.damping
    broadest = torch.argsort((energy / energy.sum(0)).sum(1), descending=True)[:_MAX_REFERENCES]
    fits = list[_Fit]()
    for reference in broadest.tolist():
        fits.append(_climb(measured, prior, reference=reference, known=fits))
    fits.append(_climb(measured, prior))
    delays, spread = torch.zeros(len(measured), dtype=torch.float64), torch.full_like(measured.power, FIRST_SPREAD)
    for _ in range(_ROUNDS_OF_FIXED_JITTER):
        spread = measured.spread(measured.concentration(spread), delays, vague=_USUAL_RECORDINGS)
    weights = measured.concentration(spread)
    turned = weights * measured.doubled(delays)
    likelihood = measured.log_likelihood(weights, spread, turned.sum(0)) + exact * len(measured)
    fits.append(_Fit(delays, turned, spread, DelayPrior(delays[:1], _MIN_JITTER_SAMPLES), likelihood))
    return max(fits, key=lambda each: each.log_posterior)


def _with_agreement(measured: MeasuredPhases, fit: _Fit) -> tuple[_Fit, PerContact]:
    """Return a fit with the delays' medians, and the probabilities that recordings agree."""
    _, odds, _ = measured.search(fit.spread, fit.turned.sum(0) - fit.turned, fit.prior)
    agreement = odds.sigmoid()
    # The share that agrees is learned from all: without common phases single recordings may agree by chance.
    for _ in range(_MAX_ROUNDS):
        share = (agreement.sum() + 1) / (len(odds) + 2)
        agreement = (odds + share.logit()).sigmoid()
    return replace(fit, delays=fit.prior.median(fit.delays, agreement)), agreement


def _climb(
    measured: MeasuredPhases,
    prior: DelayPrior,
    *,
    reference: int | None = None,
    vague: float = _USUAL_RECORDINGS,
    known: Sequence[_Fit] = (),
) -> _Fit:
    """Return the delays of a highest posterior, climbed from all recordings aligned with one, or as they are."""
    spread = torch.full_like(measured.power, FIRST_SPREAD)
    weights = measured.concentration(spread)
    delays = torch.zeros(len(measured), dtype=torch.float64)
    if reference is not None:
        alone = (weights[reference] * measured.doubled(delays)[reference]).expand(len(measured), -1)
        delays, _, _ = measured.search(spread, alone, prior)
    for turn in range(_MAX_ROUNDS):
        turned = weights * measured.doubled(delays)
        found, _, spreads = measured.search(spread, turned.sum(0) - turned, prior)
        if reference is not None:
            found = found - found.median()
        for fit in known:
            if float((found - fit.delays).abs().max()) < measured.step:
                return fit
        moved = float((found - delays).abs().max())
        delays, spread = found, measured.spread(weights, found, vague=vague)
        weights = measured.concentration(spreads)
        if turn >= _ROUNDS_OF_FIXED_JITTER:
            scale = float((delays - prior.middle).abs().median())
            prior = replace(prior, scale=min(max(_MIN_JITTER_SAMPLES, scale), _MAX_JITTER_SAMPLES))
            if moved < _CONVERGED_SAMPLES:
                break
    turned = weights * measured.doubled(delays)
    total = turned.sum(0)
    bend = (measured.turn.square() * (turned * total.conj()).real / total.abs().clamp_min(1e-300)).sum(1)
    share = float(occam_factor(prior, delays, bend).sum())
    return _Fit(delays, turned, spread, prior, measured.log_likelihood(weights, spreads, total) + share)
