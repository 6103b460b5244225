"""Modes whose frequency shifts from recording to recording, as by the mass of a roving sensor or by warming.

A pole that all recordings share then fits none of them: its phase turns away within the sound, so that its gains are
wrong, and extraction describes one mode by several poles, each for the recordings that have its frequency.

In the band around poles that lie close together, the discrete Fourier transform of a recording is, but for noise,

    X(k) = sum_j c_j D(s_j, k),  D(s, k) = (1 - z^N) / (1 - z e^(-2 pi i k / N)),  z = e^(s / rate),  s = -d + 2 pi i f.

D is analytic in s, so the poles that one recording has of its own follow from complex least squares by variable
projection (Golub and Pereyra, Inverse Problems 19, 2003): one step moves frequency and damping. Their prior is normal,
around the mean pole moved by what all modes of the recording shift alike, with one relative variance for all modes, by
Fisher's scoring. How many modes a band has, and whether they have poles of their own, is decided by the Bayesian
information criterion (Schwarz, Annals of Statistics 6, 1978); a shift counts as the part of a parameter that the
recording determines and the prior does not. A pole that stands for several unresolved modes moves in damping as much as
in frequency: that is no shift.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Complex, Complex128, Float, Float64, Int64
from scipy.stats import f as f_distribution
from torch import Tensor

from avmsf.modal.extraction.least_squares import NormalEquations, fit_gains
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import background_power

Sounds = Float[Tensor, "contacts samples"]
PerContact = Float64[Tensor, " contacts"]
PerMode = Float64[Tensor, " modes"]
CommonPoles = Complex128[Tensor, " modes"]
PerPole = Complex128[Tensor, "contacts modes"]
"""Poles of each recording's own, or what belongs to them."""
Poles = Complex128[Tensor, "*contacts modes"]
"""Common poles, or each recording's own."""


@dataclass(frozen=True)
class Tolerances:
    """Numbers of the search, chosen on two simulated objects with sensors of up to .2 % of their mass, and two real."""

    shift: float = 0.002
    """Relative frequency shift between recordings, standard deviation, before any is known; and distance within which
    poles may be one mode."""
    near_widths: float = 3.0
    """Half-power widths within which they may be one as well."""
    band_widths: float = 6.0
    """Half-power widths that a band reaches beyond its poles."""
    band_bins: int = 8
    """Bins that it reaches at least, of the whole sound's transform."""
    nepers: float = 7.0
    """Decay of a band's slowest mode within the part of the sound that is transformed."""
    modes: int = 8
    """Most poles in a band: all of their subsets are tried."""
    pitched: float = 0.1
    """Largest half-power width of a pole that may shift, over its frequency."""
    level: float = 0.01
    """Of the F test that a pole moves along frequency more than along damping. A pole that stands for several
    unresolved modes moves along both."""
    least: float = 0.05
    """Radians that a mode turns by its shift while it falls to 1/e, standard deviation: with fewer, gains at common
    poles are as good."""


_TOLERANCES = Tolerances()
_ITERATIONS = 12
"""Steps of a band's fit."""
_FREE_ITERATIONS = 2
"""Steps of them before the prior counts, whose center is not known yet."""
_MIN_SHIFT = 1e-6
"""Least relative standard deviation of the prior."""
_MIN_NOISE_POWER = 1e-12
"""Least power of the noise, of sounds of mean power one: that of a silent recording is none."""
_PASSES = 5
"""Rounds over all bands, each with the shifts of the round before as the prior."""


@dataclass(frozen=True, eq=False)
class FrequencyShifts:
    """Poles that each recording has of its own."""

    bank: ModalBank
    """The modes' mean poles."""
    poles: PerPole
    """-d + 2 pi i f, 1/s."""
    relative: float
    """Standard deviation of the relative shifts of frequency, median over modes by energy."""

    def gains(self, sounds: Sounds, *, sample_rate: float) -> Complex[Tensor, "contacts modes"]:
        """Return the gains that fit each sound best at its own poles."""
        found = [
            NormalEquations.of(sound[None], torch.exp(poles / sample_rate)).solve()
            for sound, poles in zip(sounds, self.poles, strict=True)
        ]
        return torch.complex(*torch.cat(found).to(sounds.dtype).chunk(2, dim=1))

    def removed(self, sounds: Sounds, gains: Complex[Tensor, "contacts modes"], *, sample_rate: float) -> Sounds:
        """Return the sounds as they would be if each mode had its mean pole in all of them."""
        samples = sounds.shape[1]
        common = synthesize(gains, self.bank.frequency, self.bank.damping, samples=samples, sample_rate=sample_rate)
        return sounds + (common - modal_sounds(self.poles, gains, samples, sample_rate)).to(sounds.dtype)


def find_shifts(sounds: Sounds, bank: ModalBank, *, sample_rate: float, significance: float) -> FrequencyShifts | None:
    """Return the poles of each recording's own, of modes that several poles of `bank` may be one of.

    Without those that explain less than `significance` times the energy that they would of noise, mean over the
    sounds. None where most of the energy is in modes whose frequencies do not shift.
    """
    if len(sounds) < 2:
        return None
    level = sounds.double().square().mean(1, keepdim=True).sqrt().clamp_min(torch.finfo(torch.float64).tiny)
    search, shift = _Search(sounds.double() / level, bank, sample_rate), _TOLERANCES.shift
    drift = torch.zeros(len(sounds), dtype=torch.float64)
    for _ in range(_PASSES):
        bands = search.bands(shift, drift)
        if bands is None:
            return None
        mean = torch.cat([each.mean for each in bands])
        poles = torch.cat([each.poles.expand(len(sounds), -1) for each in bands], dim=1)
        energy = torch.cat([each.energy.expand_as(each.mean.real) / len(each.mean) for each in bands])
        moves = poles.imag / mean.imag - 1.0
        drift = torch.stack([_median(each, energy) for each in moves])
        variance = _median(torch.cat([each.variance for each in bands]), energy)
        shift = float(variance.sqrt().clamp_min(_MIN_SHIFT))
        shifting = torch.cat([each.shifting for each in bands])
    if energy[shifting].sum() < 0.5 * energy.sum():
        return None
    order = torch.argsort(mean.imag)
    found = ModalBank(mean.imag / (2 * math.pi), -mean.real).take(order)
    noise = background_power(search.sounds, found, sample_rate).clamp_min(_MIN_NOISE_POWER)
    kept = _needed(search.sounds, poles[:, order], noise, significance, sample_rate)
    relative = float(_median(moves.square().mean(0).sqrt(), energy))
    return FrequencyShifts(found.take(kept), poles[:, order[kept]], relative)


@dataclass(frozen=True, eq=False)
class _Found:
    """What a band holds."""

    mean: CommonPoles
    poles: Poles
    gains: PerPole
    variance: PerMode
    """Of the relative shifts beside the drift."""
    energy: Float64[Tensor, ""]
    """Of all of its modes in all recordings, up to a factor that is the same for all bands."""

    @property
    def shifting(self) -> Bool[Tensor, " modes"]:
        """Which of its modes vary in frequency, and more than in damping."""
        moved = (self.poles - self.mean).expand_as(self.gains)
        frequency, damping = moved.imag.square().mean(0), moved.real.square().mean(0)
        freedom = len(moved) - 1
        above = frequency > damping * float(f_distribution.isf(_TOLERANCES.level, freedom, freedom))
        return above & (frequency > (_TOLERANCES.least * self.mean.real).square())


class _Search:
    """The bands of some recordings, the loudest first, each without what was found in those before it."""

    def __init__(self, sounds: Float64[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float) -> None:
        self.sounds, self.rate, self.samples = sounds, sample_rate, sounds.shape[1]
        poles = torch.complex(-bank.damping, 2 * math.pi * bank.frequency)
        gains = fit_gains(sounds, bank, sample_rate=sample_rate)
        self.left = sounds - modal_sounds(poles, gains, self.samples, sample_rate)
        """What the bands' modes, as they are known so far, leave of the sounds."""
        energy = (gains.abs().square() / bank.damping).sum(0)
        groups = sorted(_groups(bank), key=lambda rows: -float(energy[rows].sum()))
        self.common = [poles[rows] for rows in groups]
        self.known = [
            _Found(common, common, gains[:, rows], torch.zeros_like(common.real), energy[rows].sum())
            for rows, common in zip(groups, self.common, strict=True)
        ]

    def bands(self, shift: float, drift: PerContact) -> list[_Found] | None:
        """Return what each band holds, with a prior of the shifts: standard deviation and center, relative.

        None as soon as half of the energy is in modes of common poles.
        """
        half, settled = 0.5 * sum(float(each.energy) for each in self.known), 0.0
        for row, common in enumerate(self.common):
            before = self.known[row]
            if float((-common.real / common.imag).max()) > _TOLERANCES.pitched / 2:
                settled += float(before.energy)
                continue
            sounds = self.left + modal_sounds(before.poles, before.gains, self.samples, self.rate)
            band = _Band.of(sounds, common, self.rate).without_mirrored(before.poles, before.gains)
            mean, poles, variance = band.own_poles(common, shift, drift)
            self.known[row] = found = _Found(mean, poles, band.gains(poles), variance, before.energy)
            self.left = sounds - modal_sounds(poles, found.gains, self.samples, self.rate)
            settled += float(found.energy) * (found.poles.ndim == 1)
            if settled >= half:
                return None
        return self.known


@dataclass(frozen=True, eq=False)
class _Band:
    """The discrete Fourier transforms of the beginnings of some recordings, in one band."""

    spectra: Complex128[Tensor, "contacts bins"]
    bins: Float64[Tensor, " bins"]
    samples: int
    rate: float

    @classmethod
    def of(cls, sounds: Float64[Tensor, "contacts samples"], poles: CommonPoles, rate: float) -> "_Band":
        """Return the band around some poles."""
        slowest, widest = float(-poles.real.max()), float(-poles.real.min()) / math.pi
        samples = min(sounds.shape[1], math.ceil(_TOLERANCES.nepers * rate / slowest))
        lowest, highest = float(poles.imag.min()) / (2 * math.pi), float(poles.imag.max()) / (2 * math.pi)
        reach = max(
            _TOLERANCES.band_widths * widest,
            2 * _TOLERANCES.shift * highest,
            _TOLERANCES.band_bins * rate / sounds.shape[1],
        )
        first = max(1, math.floor((lowest - reach) * samples / rate))
        last = min(samples // 2 - 1, math.ceil((highest + reach) * samples / rate))
        spectra = torch.fft.rfft(sounds[:, :samples])[:, first : last + 1]
        return cls(spectra, torch.arange(first, last + 1, dtype=torch.float64), samples, rate)

    def without_mirrored(self, poles: Poles, gains: PerPole) -> "_Band":
        """Return the band without what the modes' spectra at negative frequencies, -c* D(s*) / 2i, reach into it."""
        atoms = self._atoms(poles.conj().expand(len(self.spectra), -1))[0]
        mirrored = (atoms @ (0.5j * gains.conj())[..., None])[..., 0]
        return replace(self, spectra=self.spectra - mirrored)

    def gains(self, poles: Poles) -> PerPole:
        """Return gains c of Im(c exp(s t)), which has the spectrum c D(s) / 2i beside the mirrored one."""
        atoms = self._atoms(poles.expand(len(self.spectra), -1))[0]
        # By singular values: the default driver starts its pivots from what memory holds, which changes its rounding.
        return 2j * torch.linalg.lstsq(atoms, self.spectra[..., None], driver="gelsd").solution[..., 0]

    def own_poles(
        self, common: Complex128[Tensor, " poles"], shift: float, drift: PerContact
    ) -> tuple[CommonPoles, Poles, PerMode]:
        """Return the mean poles of the modes in the band, each recording's own, or the common ones for both, and the
        variance of the relative shifts.
        """
        count, contacts = len(common), len(self.spectra)
        found = common, common, torch.zeros_like(common.real)
        best = self._criterion(self._left(common.expand(contacts, -1)), 2 * count * (contacts + 1))
        for modes in range(1, count + 1):
            mean, poles, variance, free = self._fit(self._start(common, modes), shift, drift)
            criterion = self._criterion(self._left(poles), 2 * modes * (contacts + 1) + free)
            if criterion < best:
                best, found = criterion, (mean, poles, variance)
        return found

    def _criterion(self, left: PerContact, parameters: float | int) -> float:
        """Return the Bayesian information criterion of a band of which this energy is left, real parameters counted."""
        data = 2 * self.spectra.numel()
        energy = max(float(left.sum()), torch.finfo(torch.float64).tiny)
        return data * math.log(energy / data) + parameters * math.log(data)

    def _start(self, common: Complex128[Tensor, " poles"], modes: int) -> PerPole:
        """Return for each recording the given number of the common poles that explain it best."""
        sets = torch.stack([common[list(rows)] for rows in combinations(range(len(common)), modes)])
        left = torch.stack([self._left(each.expand(len(self.spectra), -1)) for each in sets])
        return sets[left.argmin(0)]

    def _fit(self, poles: PerPole, shift: float, drift: PerContact) -> tuple[CommonPoles, PerPole, PerMode, float]:
        """Return the mean poles, those of most posterior probability, the variance of their relative shifts, and their
        number of free parameters.

        Gauss-Newton steps for all recordings at once, each damped after Levenberg and Marquardt by itself.
        """
        contacts, modes = poles.shape
        trust = torch.full((contacts,), 1e-2, dtype=torch.float64)
        variance = (shift * poles.imag.mean(0)).square()
        information, mean, center = torch.ones_like(poles.real), poles.mean(0), poles
        for turn in range(_ITERATIONS):
            jacobian, left = self._linear(poles)
            hessian, slope = jacobian.mH @ jacobian, (jacobian.mH @ left[..., None])[..., 0]
            energy = left.abs().square().sum(1)
            noise = energy.sum() / max(1, contacts * (len(self.bins) - 2 * modes))
            noise = noise.clamp_min(torch.finfo(torch.float64).tiny)
            information = torch.diagonal(hessian, dim1=1, dim2=2).real / noise
            precision = torch.zeros_like(variance)
            if turn >= _FREE_ITERATIONS:
                # The poles without their drift, each weighted by its precision about their mean.
                weight = 1.0 / (1.0 / information.clamp_min(torch.finfo(torch.float64).tiny) + variance)
                settled = torch.complex(poles.real, poles.imag / (1.0 + drift[:, None]))
                mean, precision = (weight * settled).sum(0) / weight.sum(0), 1.0 / variance
                # Where the prior expects each recording's poles.
                center = torch.complex(mean.real.expand_as(poles.real), mean.imag * (1.0 + drift[:, None]))
            penalty = noise * precision
            slope = slope - penalty * (poles - center)
            diagonal = noise * information + penalty
            added = (penalty + trust[:, None] * diagonal).clamp_min(torch.finfo(torch.float64).tiny)
            damped = hessian + torch.diag_embed(added.to(hessian.dtype))
            step = torch.linalg.solve(damped, slope[..., None])[..., 0]
            # No further than a mode's own width, and no damping that vanishes.
            step = step * (-poles.real / step.abs().clamp_min(torch.finfo(torch.float64).tiny)).clamp_max(1.0)
            moved = poles + step
            moved = torch.complex(torch.minimum(moved.real, 0.2 * poles.real), moved.imag)
            before = energy + (penalty * (poles - center).abs().square()).sum(1)
            after = self._left(moved) + (penalty * (moved - center).abs().square()).sum(1)
            better = after < before
            poles = torch.where(better[:, None], moved, poles)
            trust = torch.where(better, trust / 5, trust * 10).clamp(1e-6, 1e3)
        determined = information / (information + 1.0 / variance)
        # One step of Fisher's scoring for the variance of what is known with the variance 1 / information.
        moved = ((poles - center).abs() / variance).square() - information * (1.0 - determined).square()
        found = moved.sum(0) / (determined / variance).square().sum(0) / mean.imag.square()
        return mean, poles, found.clamp_min(0.0), 2 * float(determined.sum())

    def _atoms(
        self, poles: PerPole
    ) -> tuple[Complex128[Tensor, "contacts bins modes"], Complex128[Tensor, "contacts bins modes"]]:
        """Return D(s, k) and its derivative by s."""
        step = torch.exp(poles / self.rate)[:, None, :]
        last = torch.exp(poles * (self.samples / self.rate))[:, None, :]
        angle = -2 * math.pi / self.samples * self.bins
        turned = step * torch.polar(torch.ones_like(angle), angle)[:, None]
        rest = 1.0 - turned
        atoms = (1.0 - last) / rest
        return atoms, (atoms * turned - self.samples * last) / (rest * self.rate)

    def _linear(
        self, poles: PerPole
    ) -> tuple[Complex128[Tensor, "contacts bins modes"], Complex128[Tensor, "contacts bins"]]:
        """Return how the spectra's best fit moves with each pole, beyond what gains can follow, and what it leaves."""
        atoms, slopes = self._atoms(poles)
        basis, triangle = torch.linalg.qr(atoms)
        along = basis.mH @ self.spectra[..., None]
        gains = torch.linalg.solve_triangular(triangle, along, upper=True)
        moved = slopes * gains.mT
        return moved - basis @ (basis.mH @ moved), self.spectra - (basis @ along)[..., 0]

    def _left(self, poles: PerPole) -> PerContact:
        """Return the energy that modes of these poles leave of each spectrum."""
        basis = torch.linalg.qr(self._atoms(poles)[0])[0]
        explained = (basis.mH @ self.spectra[..., None])[..., 0]
        return (self.spectra.abs().square().sum(1) - explained.abs().square().sum(1)).clamp_min(0.0)


def _needed(
    sounds: Float64[Tensor, "contacts samples"],
    poles: PerPole,
    noise: Float64[Tensor, "contacts modes"],
    significance: float,
    rate: float,
) -> Int64[Tensor, " kept"]:
    """Return rows of the modes without those that the others make up for, the least needed one left out in turn."""
    equations = [
        NormalEquations.of(sound[None], torch.exp(own / rate)) for sound, own in zip(sounds, poles, strict=True)
    ]
    kept = torch.arange(poles.shape[1])
    while len(kept):
        lost = torch.cat([each.take(kept).lost_without()[0] for each in equations])
        ratio = (lost / noise[:, kept]).mean(0) / 2
        if float(ratio.min()) >= significance:
            break
        kept = kept[torch.arange(len(kept)) != ratio.argmin()]
    return kept


def _groups(bank: ModalBank) -> list[list[int]]:
    """Return rows of poles that lie close enough together to be one mode, by ascending frequency."""
    frequency, width = bank.frequency.tolist(), (bank.damping / math.pi).tolist()
    groups: list[list[int]] = []
    for row in range(len(bank)):
        near = row > 0 and frequency[row] - frequency[row - 1] <= max(
            _TOLERANCES.near_widths * min(width[row], width[row - 1]), _TOLERANCES.shift * frequency[row]
        )
        if near and len(groups[-1]) < _TOLERANCES.modes:
            groups[-1].append(row)
        else:
            groups.append([row])
    return groups


def modal_sounds(
    poles: Complex128[Tensor, "*#contacts modes"], gains: Complex[Tensor, "contacts modes"], samples: int, rate: float
) -> Sounds:
    """Return the sum of modes of the given poles -d + 2 pi i f, 1/s, common ones or each recording's own."""
    return synthesize(gains, poles.imag / (2 * math.pi), -poles.real, samples=samples, sample_rate=rate)


def _median(values: Float64[Tensor, " values"], weights: Float64[Tensor, " values"]) -> Float64[Tensor, ""]:
    return values.new_tensor(np.quantile(values.numpy(), 0.5, weights=weights.numpy(), method="inverted_cdf"))
