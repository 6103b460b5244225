"""The posterior of an impact's contact: gains extracted from its sound, compared with those that a field predicts."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cached_property, lru_cache, partial
from statistics import fmean
from threading import RLock

import torch
from jaxtyping import Complex64, Complex128, Float32, Float64
from scipy.sparse import csr_array
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_directions, as_samples, as_vectors, short_repr
from avmsf.errors import LocationError
from avmsf.field.sound_field import SoundField
from avmsf.localization.amplitudes import Amplitudes, Extractor
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.likelihood import Force, Likelihood, PredictedGains
from avmsf.localization.prediction import (
    calibrate_tempering,
    calibration_factor,
    distinct_contacts,
    local_variance,
    predict,
    smoothing_matrix,
)
from avmsf.localization.preprocess import check_sound, location_errors
from avmsf.modal.modes import ModalBank, cosine_distance

_MAX_CACHED_LENGTHS = 8
"""Lengths of sounds whose equations are kept."""
DETUNINGS = (0.9, 0.95, 1.05, 1.1)
"""Factors on all frequencies: 5 % is a half-power bandwidth of a mode that turns six times while it falls to 1/e."""
_LIKELY = -3.0
"""Tempered log likelihood, relative to the largest, from which on a position is likely: 5 % of its probability."""
_FORCE_DEVIATIONS = 4.0
"""Standard deviations of a known force's prior beyond which a note says that the sound contradicts it."""


@dataclass(frozen=True, eq=False)
class Locator:
    """Predicted gains of impacts at all points of a field's surface, computed once for any number of sounds."""

    __repr__ = short_repr

    field: SoundField
    points: Float32[Tensor, "points 3"]
    """Object frame, meters."""
    gains: Complex64[Tensor, "points modes"]
    """Predicted by the field: amplitudes of sines, and of cosines as imaginary part, in the training sounds' unit."""
    variance: Float32[Tensor, "points modes"]
    """Variance of the prediction: the field's posterior variance, and the variation of the gains around the point."""
    dampings: Float32[Tensor, "points modes"] | None
    """Factors on the modes' dampings; None where these do not vary over the object."""
    smoothing: csr_array | None
    """Kernel that smooths the posterior over neighboring points, by the position error of fields of few contacts; None
    for no smoothing."""
    _lock: RLock = dataclass_field(default_factory=RLock, repr=False, init=False)
    """Held while the caches change, so that threads share a locator and none repeats another's computation."""

    @classmethod
    def of(
        cls, field: SoundField, *, points: ArrayLike | None = None, directions: ArrayLike | None = None
    ) -> "Locator":
        """Return the locator of a field, over the points (meters) of its gains unless others are given.

        All points represent equal areas of surface. `directions` are those of impacts at them, as in
        `SoundField.render`. Raises LocationError for points or directions of another shape or with values that cannot
        be.
        """
        with location_errors():
            positions = as_vectors(field.gain_field.points if points is None else points, "points")
            vectors = None if directions is None else as_directions(directions, "directions", count=len(positions))
        if not len(positions):
            raise LocationError.expected("one or more", 0, name="points")
        gains, variance, dampings = predict(field, positions, vectors, factor=calibration_factor(field))
        variance = variance + local_variance(positions, gains)
        smoothing = smoothing_matrix(positions, contacts=distinct_contacts(field))
        return cls(field, positions.float(), gains, variance, dampings, smoothing)

    def locate(
        self, sound: ArrayLike, *, highest: float | None = None, force: Force | float | int | None = None
    ) -> ContactPosterior:
        """Return the posterior of the contact for a sound [samples] that starts at its onset, at the field's rate.

        The sound has 20 ms or more; what is longer than the training sounds is cut off. Modes above `highest` Hz are
        left out, for a recording of a lower sample rate. Time is stretched by up to .4 % where that makes the modes
        more probable, as an object sounds that has warmed or cooled. Fields whose dampings vary with the contact are
        compared by their mean dampings, and their gains corrected for that.

        `force`, where it is known, is the peak force of the impact: in newtons for a field that was fitted to sounds
        per newton (`Origin.per_newton`), and 1 for a sound that was divided by its force already; for another field,
        relative to an average impact of its training. A note says where the sound is too loud or too faint for that
        force at every likely position.

        Raises LocationError for sounds of several channels, too short, silent or not finite, and where the modes
        explain no more than they would of noise.
        """
        known = force if force is None or isinstance(force, Force) else Force(force)
        with location_errors():
            used = as_samples(sound, "sound")[: self.field.samples]
        check_sound(used.numpy()[None], self.field.sample_rate)
        length = self._length(len(used), float("inf") if highest is None else highest)
        used = length.extractor.stretched_to_modes(used)
        amplitudes = length.extractor.extract(used, color=self.field.residual)
        detuned = [each.explained(used) for each in length.detuned]
        # The energy without loud noise is uncertain, but no less than what modes explain, detuned or not.
        amplitudes = replace(amplitudes, energy=max(amplitudes.energy, amplitudes.fitted, *detuned))
        values, noise = length.separate(amplitudes)
        _check_above_noise(values, noise)
        scaled = None if known is None else replace(known, expected=float(known.expected) * length.unit)
        found = Likelihood(length.predicted, values, noise, force=scaled)
        # The force does not say whether the impact was on this object.
        free = found if scaled is None else Likelihood(length.predicted, values, noise)
        row = int(torch.argmax(found.log_likelihood))
        explained = length.explained(amplitudes, found, row)
        exponent = found.tempering(explained, factor=self.tempering_factor)
        probability = torch.softmax(exponent * found.log_likelihood, 0)
        if self.smoothing is not None:
            probability = torch.from_numpy(self.smoothing @ probability.numpy())
        notes: tuple[str, ...] = ()
        if scaled is not None:
            notes = _force_notes(scaled, free, exponent, length.unit, per_newton=self.field.origin.per_newton)
        return ContactPosterior(
            # A locator is kept: who converts a result's unit in place must not change the next one's.
            self.points.clone(),
            length.distance(values, noise),
            probability,
            explained,
            amplitudes.part(amplitudes.fitted),
            amplitudes.part(fmean(detuned)),
            float(found.force[row]) / length.unit,
            notes,
            free.evidence(),
        )

    def prepare(self, *samples: int) -> None:
        """Compute now what the first sound of each of these lengths, in samples, needs."""
        for length in samples:
            self._length(min(length, self.field.samples), float("inf"))

    @cached_property
    def tempering_factor(self) -> float:
        """Factor on the exponent of the tempered likelihood, by leave-one-out over the field's own contacts."""
        return calibrate_tempering(self.field)

    @cached_property
    def _lengths(self) -> "Callable[[int, float], _Length]":
        return lru_cache(_MAX_CACHED_LENGTHS)(partial(_Length, self))

    def _length(self, samples: int, highest: float) -> "_Length":
        with self._lock:
            _ = self.tempering_factor
            length = self._lengths(samples, highest)
            _ = length.extractor.beginnings
            return length


class _Length:
    """What depends on the length of a sound, for the modes up to `highest` Hz."""

    def __init__(self, locator: Locator, samples: int, highest: float) -> None:
        whole, rate = locator.field.bank, locator.field.sample_rate
        highest = min(highest, 0.5 * rate)
        modes = torch.nonzero(whole.frequency < highest).flatten()
        if not len(modes):
            got = f"{len(whole)} from {float(whole.frequency.min()):g} Hz on"
            advice = "record at a higher sample rate"
            raise LocationError.expected(f"some below {highest:g} Hz", highest, got=got, name="modes", advice=advice)
        bank = ModalBank(whole.frequency[modes].double(), whole.damping[modes].double())
        self.extractor = Extractor(bank, sample_rate=rate, samples=samples, highest=highest)
        gains = locator.gains[:, modes]
        if locator.dampings is not None:
            gains = gains * _damping_corrected(bank.damping, locator.dampings[:, modes], samples / rate)
        self.unit = float(gains.abs().square().mean().sqrt())
        if self.unit == 0.0:
            got, advice = "0 at all points", "fit it to other recordings"
            raise LocationError.expected("gains above 0", 0.0, got=got, name="field", advice=advice)
        self.gains = gains / self.unit
        """Of the modes themselves, [points, modes], in units of `unit`."""
        self.predicted = _decorrelated(self.gains, locator.variance[:, modes] / self.unit**2, self.extractor)
        """Amplitudes of the decorrelated mixtures of modes, in units of `unit`."""
        below = [(factor, factor * bank.frequency < highest) for factor in DETUNINGS]
        banks = [ModalBank(factor * bank.frequency[low], bank.damping[low]) for factor, low in below if bool(low.any())]
        self.detuned = [Extractor(each, sample_rate=rate, samples=samples) for each in banks]
        """For the null model: of the modes at each of `DETUNINGS` that stay below the highest frequency, if any do."""

    def separate(self, amplitudes: Amplitudes) -> tuple[Complex128[Tensor, " modes"], Float64[Tensor, " modes"]]:
        """Return the amplitudes of decorrelated mixtures of modes, and the variances of their errors."""
        mixing, spread = self.extractor.separated
        noise = mixing.abs().square().T @ amplitudes.noise
        # Above zero, for rounding in float32.
        least = 1e-10 * float(amplitudes.values.abs().max()) ** 2
        return mixing.mH @ amplitudes.values, noise * spread + least

    def distance(
        self, values: Complex128[Tensor, " modes"], noise: Float64[Tensor, " modes"]
    ) -> Float64[Tensor, " points"]:
        """Return the cosine distance of each point's gains from the recorded ones without their expected noise."""
        power = values.abs().square()
        kept = ((power - noise) / power.clamp_min(1e-300)).clamp_min(0.0)
        recorded = self.extractor.separated[0] @ (kept * values)
        return cosine_distance(self.gains, recorded, self.extractor.bank.frequency)

    def explained(self, amplitudes: Amplitudes, found: Likelihood, row: int) -> float:
        """Return the fraction of the sound's energy that an impact at a point explains."""
        angle = 2.0 * torch.pi * float(found.shift[row]) * self.extractor.bank.frequency
        rotated = torch.polar(found.force[row].abs().expand_as(angle), angle)
        predicted = self.extractor.separated[0] @ self.predicted.gains[row].to(torch.complex128)
        own = predicted * rotated * found.force[row].sign()
        both = torch.cat([own.real, own.imag])
        return amplitudes.part(float(2.0 * both @ amplitudes.products - both @ self.extractor.gram @ both))


def _damping_corrected(
    damping: Float64[Tensor, " modes"], factors: Float32[Tensor, "points modes"], seconds: float
) -> Float32[Tensor, "points modes"]:
    """Return the factor on a mode's amplitude by fitting it with the shared damping instead of its own."""
    both, own = damping * (1.0 + factors.double()), 2.0 * damping
    shared = torch.expm1(-both * seconds) / both
    return (shared / (torch.expm1(-own * seconds) / own)).float()


def _decorrelated(
    gains: Complex64[Tensor, "points modes"], variance: Float32[Tensor, "points modes"], extractor: Extractor
) -> PredictedGains:
    """Return the predicted amplitudes of the decorrelated mixtures of modes."""
    mixing, _ = extractor.separated
    shares = mixing.abs().square()
    correlated = torch.nonzero(torch.diagonal(shares) < 1.0 - 1e-9).flatten()
    if len(correlated):
        inner = mixing[correlated][:, correlated]
        gains, variance = gains.clone(), variance.clone()
        gains[:, correlated] = gains[:, correlated] @ inner.conj().to(torch.complex64)
        variance[:, correlated] = variance[:, correlated] @ inner.abs().square().float()
    return PredictedGains(gains, variance, shares.T @ extractor.bank.frequency)


def _force_notes(force: Force, free: Likelihood, exponent: float, unit: float, *, per_newton: bool) -> tuple[str, ...]:
    """Return a note where no likely position has about that force; `free` is what the sound says without it."""
    likely = exponent * (free.log_likelihood - free.log_likelihood.max()) > _LIKELY
    forces = free.force[likely].abs()
    level = 20.0 * (forces / force.expected).log10().abs()
    if float(level.min()) <= _FORCE_DEVIATIONS * force.spread_db:
        return ()
    fitting, given = float(forces[level.argmin()]) / unit, force.expected / unit
    meaning = (
        "that of a recording which was divided by its force is 1"
        if per_newton
        else "for this field, whose recordings were not divided by their forces, 1 is that of an average one"
    )
    return (f"expected a force of about {fitting:.2g} by the sound's level, got {given:.3g}; {meaning}",)


def _check_above_noise(values: Complex128[Tensor, " modes"], noise: Float64[Tensor, " modes"]) -> None:
    """Raise LocationError where the amplitudes are no larger than by noise alone."""
    surplus = values.abs().square() / noise
    modes = len(values)
    chance, clear = 1.0 + 5.0 / modes**0.5, 12.0 + float(torch.log(torch.tensor(float(modes))))
    mean = float(surplus.mean())
    if mean < chance and float(surplus.max()) < clear:
        wanted, got = f"the object's {modes} modes at {chance:.2g} times it or more", f"{mean:.2g} times"
        advice = "record the impact louder, or with less noise"
        raise LocationError.expected(wanted, mean, got=got, name="noise", advice=advice)
