"""How a capture's recordings were aligned, and what modes show of recorders and editors.

Faults are inverted polarity, other sample rates, fades, gates and automatic gain.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import torch
from jaxtyping import Float64
from scipy.special import stdtr
from torch import Tensor

from avmsf._utils.text import listed
from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank, common_phase, synthesize

_SHOWN = 8
"""Recordings that a sentence names."""


@dataclass(frozen=True)
class AlignmentReport:
    """How recordings were aligned, as plain values."""

    coherence_before: float
    coherence_after: float
    delays: dict[str, float]
    """Samples by which each recording starts later than it was read."""
    not_aligned: list[str]
    inverted: list[str]
    """Recordings of the opposite sign."""
    rate_factors: dict[str, float]
    """Recordings of another sample rate than their files give, and by how much their modes are higher."""
    uneven_decay_db: float | None
    """By how much a slice sounds fall more than vibrations do; None where they do not."""
    noise_drop_db: float | None
    """By how much noise is louder before the impacts than after; None where it is not."""
    gain_changes_db: dict[str, float]
    """Recordings of another gain, and by how much it is higher."""

    @classmethod
    def of(cls, modes: Extraction, impacts: Impacts) -> "AlignmentReport | None":
        """Return the report on the recordings that the modes are of; None where nothing was aligned."""
        found = modes.alignment
        if found is None:
            return None
        left = [name for name, likely in zip(found.names, found.agreement.tolist(), strict=True) if likely < 0.5]
        delays = dict(zip(found.names, found.delays.tolist(), strict=True))
        aligned, inverted = modes.aligned(impacts), list(inverted_recordings(modes, impacts))
        faults = rate_factors(modes, aligned), uneven_decay(modes, aligned)
        levels = noise_drop(modes, impacts), gain_changes(impacts)
        return cls(found.coherence_before, found.coherence_after, delays, left, inverted, *faults, *levels)

    @property
    def doubtful(self) -> set[str]:
        """The recordings that something is wrong with."""
        return {*self.not_aligned, *self.inverted, *self.rate_factors, *self.gain_changes_db}

    def sentences(self) -> list[str]:
        """Return the faults of recordings, and how coherent the modes' phases are."""
        delays = self._moved
        if not delays:
            return self.warnings()
        how, after = "no delays make the modes' phases agree better than they do as read", ""
        if any(delays):
            how = f"delays of {min(delays):.2f} to {max(delays):.2f} samples align the recordings"
            after = f", {self.coherence_after:.2f} aligned"
        coherence = f"coherence {self.coherence_before:.2f} as read{after} (1 is one phase for each mode)"
        return [*self.warnings(), f"{how}: {coherence}"]

    def warnings(self) -> list[str]:
        """Return a sentence for each fault that recorders and editors make, and for recordings that are not aligned."""
        found = [
            f"{name}: all its modes are {factor:.4g} times the others': it was recorded at {1 / factor:.4g} times the "
            "sample rate that its file gives; convert it from that rate, or remove its row"
            for name, factor in self.rate_factors.items()
        ]
        found += [
            f"{name}: its noise and its sound are both about {abs(change):.0f} dB {'above' if change > 0 else 'below'} "
            "the others: another gain or scale; export it as the others, record it again, or remove its row"
            for name, change in self.gain_changes_db.items()
        ]
        if self.uneven_decay_db is not None:
            found.append(
                f"the sounds fall by {self.uneven_decay_db:.0f} dB more, within a twelfth of their length, than "
                "vibrations do: a fade-out or a noise gate; export them without it, or write fewer seconds in "
                "capture.toml"
            )
        if self.noise_drop_db is not None:
            found.append(
                f"the noise is {self.noise_drop_db:.0f} dB louder before the impacts than after: an automatic gain "
                "changes levels and decays; turn it off and record again"
            )
        if not self._moved:
            found.append(
                f"the modes have no common phase (coherence {self.coherence_before:.2f}, 1 is one phase for each "
                "mode): the recordings are not aligned. Check whether the sensor or the object was moved, and the "
                "response channel"
            )
            return found
        for names, words, remedy in (
            (self.not_aligned, "not aligned: {}", "the phases of their modes agree with those of no other recording"),
            (
                self.inverted,
                "inverted polarity: {} have the opposite sign of the recordings near them",
                "check the cable and the file, or the direction in impacts.csv",
            ),
        ):
            found += [f"{words.format(listed(names, most=_SHOWN))}; {remedy}"] if names else []
        return found

    @property
    def _moved(self) -> list[float]:
        """The delays of the recordings that are aligned, samples."""
        return [delay for name, delay in self.delays.items() if name not in self.not_aligned]


_RATES_HZ = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000, 88200, 96000, 176400, 192000)
"""Sample rates of recorders and files."""
_OTHERS_SHARE = 0.01
"""Least part of the others' energy that a mode of theirs has, mean over them."""
_SLICES = 12
"""Of each sound, in which levels are compared."""
_SURROGATES = 8
"""Sounds of the same modes and other noise that each recording is compared with."""
_MIN_RECORDINGS = 6
"""Recordings below which the spread of their noise, or of the correlations of their gains, is not known."""
_NAMED = 0.0228
"""Probability that a recording of the same gain is named: that of two standard errors of a normal distribution."""
_FALSE_ALARM = 1e-3
"""Probability that a capture without the fault is said to have it."""
_LENGTHS = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Length scales over the diagonal of the contacts' bounding box."""
_NOISES = (0.01, 0.03, 0.1, 0.3, 1.0)
"""Variances of what neighbors do not predict, over the kernel's."""
_MIN_CORRELATION = 0.5
"""Median correlation below which neighbors explain less than a quarter of the gains' energy, and nothing is judged."""
_NORMAL = 1.4826
"""Standard deviation of normal numbers over the median distance from their median."""


def rate_factors(modes: Extraction, impacts: Impacts) -> dict[str, float]:
    """Return by how much all modes of a recording are higher than the others', for each in which they are.

    `modes` are those of all the aligned `impacts`. A recording is one of them where the modes of the others explain
    less than half of its energy, and explain half of it or more with all frequencies and dampings times the ratio of
    two usual sample rates, the best of these: its file gives another rate than it was recorded at.
    """
    power = torch.view_as_real(modes.gains).double().square().sum(-1) / modes.bank.damping
    power = power / power.sum(1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
    ratios = sorted({one / other for one, other in product(_RATES_HZ, _RATES_HZ)} - {1.0})
    found = {}
    for row, name in enumerate(impacts.names):
        theirs = (power.sum(0) - power[row]) / max(1, len(power) - 1) >= _OTHERS_SHARE
        bank = modes.bank.take(theirs)
        explained = partial(_explained, impacts.sounds[row : row + 1].double(), bank, impacts.sample_rate)
        if len(bank) == 0 or explained(1.0) >= 0.5:
            continue
        best = max(ratios, key=explained)
        if explained(best) >= 0.5:
            found[name] = best
    # Where most are named, the modes found are none of the object's.
    return found if 2 * len(found) < len(impacts) else {}


def uneven_decay(modes: Extraction, impacts: Impacts) -> float | None:
    """Return by how many dB a slice sounds fall more than decaying modes with noise do; None where they do not.

    The energy of damped modes and stationary noise falls ever slower, apart from beats and the noise's chance. So for
    each recording the largest growth of the fall between slices is compared with that of its own modes with noise of
    its residual's spectrum in random phases (surrogate data: Theiler et al., Physica D 58, 1992): Student's test over
    recordings. A fade-out or a noise gate makes sounds fall faster, which no object does. `modes` are those of all the
    aligned `impacts`.
    """
    size = impacts.sounds.shape[1] // _SLICES
    sounds = impacts.sounds[:, : _SLICES * size].double()
    modal = _modal(sounds, modes.bank, impacts.sample_rate)
    half = (sounds - modal)[:, -(_SLICES // 2) * size :]
    spectrum, generator = torch.fft.rfft(half).abs(), torch.Generator().manual_seed(0)
    usual = torch.zeros(len(sounds), dtype=torch.float64)
    for _ in range(_SURROGATES):
        phase = 2 * math.pi * torch.rand(spectrum.shape, generator=generator, dtype=torch.float64)
        noise = torch.fft.irfft(torch.polar(spectrum, phase), half.shape[1]).repeat(1, 2)
        usual += _fall_growth(modal + noise) / _SURROGATES
    return _surely_positive(_fall_growth(sounds) - usual)


def noise_drop(modes: Extraction, impacts: Impacts) -> float | None:
    """Return by how many dB noise is louder before the impacts than what modes leave after them; None where it is not.

    What modes leave is the noise, and more where they do not explain all. It is less where an automatic gain turns
    itself down at the impact. Compared are the first half of what is kept before the onset and the second to sixth
    twelfth of the sounds: Student's test over recordings. `impacts` are not yet aligned.
    """
    if impacts.before is None or not bool(torch.isfinite(impacts.before[:, : impacts.before.shape[1] // 2]).all()):
        return None
    before = impacts.before[:, : impacts.before.shape[1] // 2].double().square().mean(1)
    sounds = modes.aligned(impacts).sounds.double()
    left = (sounds - _modal(sounds, modes.bank, impacts.sample_rate)).square()
    part = left.shape[1] // _SLICES
    after = left[:, part : _SLICES // 2 * part].mean(1)
    silent = torch.minimum(before, after) <= 1e-14 * sounds.square().amax(1)
    return None if bool(silent.any()) else _surely_positive(10 * torch.log10(before / after))


def gain_changes(impacts: Impacts) -> dict[str, float]:
    """Return by how many dB the gain of a recording is higher than the others', where its noise and its sound are.

    An impact may be soft, and a room quiet; a gain changes both. The noise before the onset has to differ from that of
    the other recordings by more than chance (Student's predictive distribution, Bonferroni's correction) and by more
    than two standard deviations of their levels, less being what impacts do; and the sound has to be nearer to theirs
    without that difference. `impacts` are not yet aligned.
    """
    count = len(impacts)
    if count < _MIN_RECORDINGS or impacts.before is None:
        return {}
    before = impacts.before[:, : impacts.before.shape[1] * 3 // 4].double().square().mean(1)
    sound = impacts.sounds.double().square().mean(1)
    if not bool((before > 1e-14 * sound.max()).all()):
        return {}
    (noise, noise_std), (level, level_std) = (_from_others(10 * torch.log10(each)) for each in (before, sound))
    chance = 2 * count * torch.from_numpy(stdtr(count - 2, -(noise.abs() / noise_std).numpy()))
    named = (chance < _NAMED) & (noise.abs() > 2 * level_std) & ((level - noise).abs() < level.abs())
    return {impacts.names[row]: float(noise[row]) for row in torch.nonzero(named).flatten().tolist()}


def _from_others(
    values: Float64[Tensor, " contacts"],
) -> tuple[Float64[Tensor, " contacts"], Float64[Tensor, " contacts"]]:
    """Return each value's difference from the mean of the others, and the standard deviation that it should have."""
    count = len(values)
    rest = values.expand(count, count)[~torch.eye(count, dtype=torch.bool)].reshape(count, count - 1)
    return values - rest.mean(1), (rest.std(1) * math.sqrt(1 + 1 / (count - 1))).clamp_min(1e-9)


def _surely_positive(values: Float64[Tensor, " contacts"]) -> float | None:
    """Return the mean over recordings where it is above zero by more than chance, else None."""
    mean, error = float(values.mean()), float(values.std()) / math.sqrt(len(values))
    return mean if stdtr(len(values) - 1, -mean / max(error, 1e-9)) < _FALSE_ALARM else None


def _explained(
    sounds: Float64[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float, factor: float
) -> float:
    """Return the part of the energy that modes explain with frequencies and dampings times a factor."""
    kept = factor * bank.frequency < sample_rate / 2
    scaled = ModalBank(factor * bank.frequency[kept], factor * bank.damping[kept])
    return 1.0 - float((sounds - _modal(sounds, scaled, sample_rate)).square().sum() / sounds.square().sum())


def _fall_growth(sounds: Float64[Tensor, "contacts samples"]) -> Float64[Tensor, " contacts"]:
    """Return by how many dB a slice each sound falls at most more than before."""
    power = sounds.reshape(len(sounds), _SLICES, -1).square().mean(2)
    # Digital silence is taken for a rounding error of single precision.
    level = 10 * torch.log10(power.clamp_min(1e-14 * power.amax(1, keepdim=True)))
    fall = -level.diff(dim=1)
    return (fall - fall.cummin(1).values).amax(1)


def _modal(
    sounds: Float64[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float
) -> Float64[Tensor, "contacts samples"]:
    """Return what modes explain of sounds, by least squares."""
    gains = fit_gains(sounds, bank, sample_rate=sample_rate)
    return synthesize(gains, bank.frequency, bank.damping, samples=sounds.shape[1], sample_rate=sample_rate)


def inverted_recordings(modes: Extraction, impacts: Impacts) -> tuple[str, ...]:
    """Return the names of recordings whose sign is the opposite of the others'; `modes` are those of `impacts`.

    Phases are aligned modulo pi, so they do not show it. What does is the gains over the object: near contacts, struck
    in the same direction, have gains of the same sign. Each mode's gains along its phase are predicted at every contact
    from all others by a Gaussian process whose length scale and noise have the greatest likelihood over all modes. The
    correlation of predicted and measured gains over modes is about c for most recordings, and about -c for an inverted
    one.

    Empty where contacts lie so far apart that neighbors do not determine a gain's sign. Recordings that could not be
    aligned are not judged.
    """
    if modes.alignment is not None and len(left := torch.nonzero(modes.alignment.agreement < 0.5)):
        rows = [row for row in range(len(impacts)) if row not in left]
        impacts = impacts.take(rows)
        modes = replace(modes.take(rows), alignment=None)
    signs, found = torch.ones(len(impacts), 1, dtype=torch.float64), list[int]()
    while len(impacts) >= _MIN_RECORDINGS and len(found) < len(impacts) // 3:
        # One at a time: an inverted recording spoils what is predicted at its neighbors.
        turned = replace(modes, gains=modes.gains * signs)
        correlation = _predicted(turned, impacts)
        usual, worst = float(correlation.median()), int(correlation.argmin())
        deviation = max(_NORMAL * float((correlation - usual).abs().median()), 1 / math.sqrt(len(modes.bank)))
        # The log odds of a correlation about -c to one about c, of so many recordings.
        odds = -2 * usual * float(correlation[worst]) / deviation**2
        if usual < _MIN_CORRELATION or odds < math.log(len(impacts) / _FALSE_ALARM) or worst in found:
            break
        found.append(worst)
        signs[worst] = -1.0
    return tuple(impacts.names[row] for row in sorted(found))


def _predicted(modes: Extraction, impacts: Impacts) -> Float64[Tensor, " contacts"]:
    """Return the correlation, over modes, of each recording's gains with those predicted from all others."""
    phase = common_phase(modes.gains)
    gains = modes.gains.to(torch.complex128)
    along = gains.real * phase.cos() + gains.imag * phase.sin()
    energy = (gains.real.square() + gains.imag.square()) / modes.bank.damping
    # Every recording counts alike, however loud, and every mode by its energy.
    along = along / modes.bank.damping.sqrt() / energy.sum(1, keepdim=True).sqrt().clamp_min(1e-300)
    contacts = impacts.contacts.double()
    distance = torch.cdist(contacts, contacts) / (contacts.amax(0) - contacts.amin(0)).norm().clamp_min(1e-300)
    facing = torch.ones_like(distance)
    if impacts.directions is not None:
        facing = impacts.directions.double() @ impacts.directions.double().T
    best, chosen, share = -math.inf, along, along.square().sum(0) / along.square().sum()
    for length, noise in product(_LENGTHS, _NOISES):
        kernel = facing * torch.exp(-0.5 * (distance / length).square())
        whole = kernel + noise * torch.eye(len(kernel), dtype=torch.float64)
        inverse = torch.linalg.inv(whole)
        solved = inverse @ along
        scale = (along * solved).sum(0).clamp_min(1e-300)
        # Each mode's own variance is integrated out.
        likelihood = -0.5 * len(along) * (scale.log() * share).sum() - 0.5 * torch.logdet(whole)
        if float(likelihood) > best:
            best, chosen = float(likelihood), along - solved / torch.diagonal(inverse)[:, None]
    sizes = (along.norm(dim=1) * chosen.norm(dim=1)).clamp_min(1e-300)
    return (along * chosen).sum(1) / sizes
