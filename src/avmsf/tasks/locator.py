"""From the sound of a blow to where it fell: the gains heard in it against those that the field foretells."""

from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cached_property
from threading import RLock

import torch
from jaxtyping import Complex64, Complex128, Float, Float32, Float64
from scipy.sparse import csr_array
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_floats
from avmsf._utils.summary import short_repr
from avmsf.capture.prepare import shortest_allowed
from avmsf.errors import LocationError
from avmsf.field.soundfield import SoundField
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.cosine_distance import cosine_distance
from avmsf.modal.bank import ModalBank
from avmsf.tasks.amplitudes import Amplitudes, Extractor
from avmsf.tasks.detuning import OutOfTune
from avmsf.tasks.foretelling import foretell, patches, unknown, widened
from avmsf.tasks.hearing import not_finite, silent, too_short
from avmsf.tasks.heed import heed_of
from avmsf.tasks.posterior import Force, Foretold, Judgement, judge
from avmsf.tasks.slack import contacts_of, spread_by

_UNIT = 1e-3
"""How far a direction's length may be from one."""
_KEPT_LENGTHS = 8
"""Lengths of sounds whose equations are kept."""
_LIKELY = -3.0
"""Tempered log likelihood, relative to the largest, from which on a position is likely: 5 % of its probability."""
_FORCE_DEVIATIONS = 4.0
"""Standard deviations of a known force's prior beyond which a note says that the sound contradicts it."""


@dataclass(frozen=True, eq=False)
class Locator:
    """What blows at all points of a field's surface are foretold to sound like, ready for any number of sounds."""

    __repr__ = short_repr

    field: SoundField
    points: Float32[Tensor, "points 3"]
    """Object frame, meters."""
    gains: Complex64[Tensor, "points modes"]
    """What the field foretells: amplitudes of sines, and of cosines as imaginary part, in the training sounds' unit."""
    variance: Float32[Tensor, "points modes"]
    """How wrong these are thought to be: what the field does not know, and how they vary about the point."""
    dampings: Float32[Tensor, "points modes"] | None
    """Factors on the modes' dampings, where the field has these vary."""
    areas: Float64[Tensor, " points"]
    """What each point stands for, relative."""
    slack: csr_array | None
    """Moves probability to the points about, by how far off a field's places are; None where that is nothing."""
    heeds_residual: bool
    """Whether gains that could be noise count for less."""
    lengths: dict[tuple[int, float], "_Length"] = dataclass_field(default_factory=dict, repr=False)
    """What is known of sounds of lengths met before."""
    _lock: RLock = dataclass_field(default_factory=RLock, repr=False)
    """Held while something is cached, so that threads share a locator and none repeats another's computation."""

    @classmethod
    def of(
        cls,
        field: SoundField,
        *,
        points: ArrayLike | None = None,
        directions: ArrayLike | None = None,
        areas: ArrayLike | None = None,
        use_residual: bool = True,
    ) -> "Locator":
        """Return the locator of a field, over the points (meters) of its gains unless others are given.

        `directions`, unit vectors, are those of blows at the points; without them they go straight into the surface.
        `areas` are how much of the surface each point stands for, in any unit; without them all the same. Without
        `use_residual` nothing is taken for noise (the paper's ablation). Raises LocationError for points, directions
        or areas that are none.
        """
        places = as_floats(field.gain_field.points if points is None else points, "points")
        ways = None if directions is None else as_floats(directions, "directions")
        parts = None if areas is None else as_floats(areas, "areas")
        _expect_points(places, ways, parts)
        gains, dampings = foretell(field, places, ways)
        variance = unknown(field, places, ways, factor=widened(field))
        return cls(
            field,
            places.float(),
            gains,
            variance + patches(places, gains),
            dampings,
            torch.ones(len(places), dtype=torch.float64) if parts is None else parts.double(),
            spread_by(places, contacts=contacts_of(field)),
            use_residual,
        )

    def locate(
        self,
        sound: Float[Tensor, " samples"],
        *,
        highest: float | None = None,
        force: Force | float | int | ArrayLike | None = None,
    ) -> ContactMap:
        """Return how well a blow at each point explains a sound that starts at its onset, at the field's rate.

        20 ms and more; what is longer than the training sounds is not heard. Modes above `highest` Hz are left out,
        for a recording that does not hold them. `force`, where it is known, is the peak force of the impact: in newtons
        for a field that was fitted to sounds per newton (`Origin.per_newton`), and 1 for a sound that was divided by
        its force already; for another field, relative to an average impact of its training. A note says where the
        sound is too loud or too faint for that force at every likely position. Fields whose dampings vary with the
        contact are heard through their mean dampings, and their gains corrected for that. Raises LocationError for
        sounds that are too short, silent or not finite, and where the modes explain no more than they would of noise.
        """
        known = None if force is None else Force.of(force)
        heard = sound.detach().cpu()[: self.field.samples]
        self._expect_sound(heard)
        length = self._length(len(heard), float("inf") if highest is None else highest)
        amplitudes = length.extractor.extract(heard, color=self.field.residual if self.heeds_residual else None)
        detuned = length.detuned.fitted(heard)
        # What is left beside loud noise is known badly, but it is no less than what modes explain, in tune or not.
        amplitudes = replace(amplitudes, energy=max(amplitudes.energy, amplitudes.fitted, float(detuned.max())))
        values, noise = length.separate(amplitudes)
        _expect_more_than_noise(values, noise)
        scaled = length.scaled(known)
        found = judge(length.foretold, values, noise, force=scaled)
        # How hard the blow was does not say whether it was one on this object.
        free = found if scaled is None else judge(length.foretold, values, noise)
        row = int(torch.argmax(found.log_likelihood))
        explained = length.explained(amplitudes, found, row)
        trust = found.trust(explained, heed=self.heed)
        probability = torch.softmax(trust * found.log_likelihood + self.areas.log(), 0)
        if self.slack is not None:
            probability = torch.from_numpy(self.slack @ probability.numpy())
        return ContactMap(
            self.points,
            length.distance(values, noise),
            probability,
            explained,
            amplitudes.explained,
            amplitudes.part(float(detuned.mean())),
            float(found.force[row]) / length.unit,
            evidence=free.evidence(self.areas),
            notes=() if scaled is None else _force_notes(scaled, free, trust, length.unit),
        )

    def prepare(self, *samples: int) -> None:
        """Compute now what the first sound of each of these lengths would have to wait for."""
        _ = self.heed
        for length in samples:
            self._length(min(length, self.field.samples), float("inf"))

    @property
    def heed(self) -> float:
        """Factor on what modes tell beside one another: as much as the field's own strikes, left out, bear out."""
        with self._lock:
            return self._heed

    @cached_property
    def _heed(self) -> float:
        return heed_of(self.field)

    def _expect_sound(self, sound: Float[Tensor, " samples"]) -> None:
        rate = self.field.sample_rate
        least = shortest_allowed(rate)
        if len(sound) < least:
            raise too_short(None, len(sound), least, rate)
        wrong = int((~torch.isfinite(sound)).sum())
        if wrong:
            raise not_finite(None, wrong)
        if float(sound.max()) == float(sound.min()):
            raise silent(None)

    def _length(self, samples: int, highest: float) -> "_Length":
        key = (samples, highest)
        with self._lock:
            # What is used moves to the end, so that what a stream needs again and again is never the oldest.
            found = self.lengths.pop(key, None)
            if found is None:
                while len(self.lengths) >= _KEPT_LENGTHS:
                    del self.lengths[next(iter(self.lengths))]
                found = _Length.of(self, samples, highest)
            self.lengths[key] = found
        return found


@dataclass(frozen=True, eq=False)
class _Length:
    """What is known of all sounds of one length."""

    extractor: Extractor
    foretold: Foretold
    """Of the mixtures of modes that can be told apart, in units of `unit`."""
    gains: Complex64[Tensor, "points modes"]
    """The modes' own gains at each point, in units of `unit`."""
    unit: float
    detuned: OutOfTune

    @classmethod
    def of(cls, locator: Locator, samples: int, highest: float) -> "_Length":
        """Return it for the modes up to `highest` Hz."""
        whole, rate = locator.field.bank, locator.field.sample_rate
        highest = min(highest, 0.5 * rate)
        heard = torch.nonzero(whole.frequency < highest).flatten()
        if not len(heard):
            raise LocationError(
                f"expected modes below {highest:g} Hz, got {len(whole)} from {float(whole.frequency.min()):g} Hz on; "
                "record at a higher sample rate",
                name="modes",
                value=highest,
            )
        bank = ModalBank(whole.frequency[heard].double(), whole.damping[heard].double())
        extractor = Extractor.of(bank, sample_rate=rate, samples=samples, highest=highest)
        gains = locator.gains[:, heard]
        if locator.dampings is not None:
            gains = gains * _seen_through(bank.damping, locator.dampings[:, heard], samples / rate)
        unit = float(gains.abs().square().mean().sqrt())
        if unit == 0.0:
            raise LocationError.expected(
                "gains above 0", 0.0, got="0 at all points", name="field", advice="fit it to other recordings"
            )
        gains = gains / unit
        foretold = _mixed(gains, locator.variance[:, heard] / unit**2, extractor)
        detuned = OutOfTune.of(bank, sample_rate=rate, samples=samples, highest=highest)
        return cls(extractor, foretold, gains, unit, detuned)

    def separate(self, amplitudes: Amplitudes) -> tuple[Complex128[Tensor, " modes"], Float64[Tensor, " modes"]]:
        """Return the amplitudes of mixtures, and the variances of their independent errors."""
        mixing = self.extractor.mixing
        noise = mixing.abs().square().T @ amplitudes.noise
        # Never quite zero: what is exact in arithmetic is not in float32.
        least = 1e-10 * float(amplitudes.values.abs().max()) ** 2
        return mixing.mH @ amplitudes.values, noise * self.extractor.spread + least

    def scaled(self, force: Force | None) -> Force | None:
        """Return a known force in the unit of the gains here."""
        return None if force is None else replace(force, expected=force.expected * self.unit)

    def distance(
        self, values: Complex128[Tensor, " modes"], noise: Float64[Tensor, " modes"]
    ) -> Float64[Tensor, " points"]:
        """Return the cosine distance of each point's gains from the recorded ones without their expected noise."""
        power = values.abs().square()
        kept = ((power - noise) / power.clamp_min(1e-300)).clamp_min(0.0)
        recorded = self.extractor.mixing @ (kept * values)
        return cosine_distance(self.gains, recorded, self.extractor.bank.frequency)

    def explained(self, amplitudes: Amplitudes, found: Judgement, row: int) -> float:
        """Return the part of the sound's energy that a blow at a point explains."""
        extractor = self.extractor
        turned = torch.polar(
            found.force[row].expand(len(extractor.bank)).abs(),
            2.0 * torch.pi * float(found.shift[row]) * extractor.bank.frequency,
        )
        own = extractor.mixing @ self.foretold.gains[row].to(torch.complex128) * turned * found.force[row].sign()
        both = torch.cat([own.real, own.imag])
        return amplitudes.part(float(2.0 * both @ amplitudes.products - both @ extractor.gram @ both))


def _seen_through(
    damping: Float64[Tensor, " modes"], factors: Float32[Tensor, "points modes"], seconds: float
) -> Float32[Tensor, "points modes"]:
    """Return the amplitude that a mode of another damping seems to have, looked at with the shared one."""
    both, own = damping * (1.0 + factors.double()), 2.0 * damping
    shared = torch.expm1(-both * seconds) / both
    return (shared / (torch.expm1(-own * seconds) / own)).float()


def _mixed(
    gains: Complex64[Tensor, "points modes"], variance: Float32[Tensor, "points modes"], extractor: Extractor
) -> Foretold:
    """Return what is foretold of mixtures of modes."""
    mixing = extractor.mixing
    shares = mixing.abs().square()
    entangled = torch.nonzero(torch.diagonal(shares) < 1.0 - 1e-9).flatten()
    if len(entangled):
        inner = mixing[entangled][:, entangled]
        gains, variance = gains.clone(), variance.clone()
        gains[:, entangled] = gains[:, entangled] @ inner.conj().to(torch.complex64)
        variance[:, entangled] = variance[:, entangled] @ inner.abs().square().float()
    power = gains.abs().square()
    usual = power.mean(0)
    usual = usual.clamp_min(1e-8 * float(usual.max()))
    return Foretold(gains, power, variance, usual, shares.T @ extractor.bank.frequency)


def _force_notes(force: Force, free: Judgement, trust: float, unit: float) -> tuple[str, ...]:
    """Return a note where no likely position has about that force; `free` is what the sound says without it."""
    likely = trust * (free.log_likelihood - free.log_likelihood.max()) > _LIKELY
    forces = free.force[likely].abs()
    level = 20.0 * (forces / force.expected).log10().abs()
    if float(level.min()) <= _FORCE_DEVIATIONS * force.spread_db:
        return ()
    fitting, given = float(forces[level.argmin()]) / unit, force.expected / unit
    return (
        f"expected a force of about {fitting:.2g} by the sound's level, got {given:.3g}; the force of a recording that "
        "was divided by its force is 1",
    )


def _expect_more_than_noise(values: Complex128[Tensor, " modes"], noise: Float64[Tensor, " modes"]) -> None:
    """Raise LocationError where the amplitudes are what noise alone would leave."""
    surplus = values.abs().square() / noise
    modes = len(values)
    chance, clear = 1.0 + 5.0 / modes**0.5, 12.0 + float(torch.log(torch.tensor(float(modes))))
    if float(surplus.mean()) < chance and float(surplus.max()) < clear:
        raise LocationError(
            f"expected the object's {modes} modes at {chance:.2g} times the noise or more, got "
            f"{float(surplus.mean()):.2g} times; record it louder, or with less noise",
            name="noise",
            value=float(surplus.mean()),
        )


def _expect_points(
    points: Float[Tensor, "..."],
    directions: Float[Tensor, "..."] | None,
    areas: Float[Tensor, "..."] | None,
) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not bool(torch.isfinite(points).all()):
        wrong, shape = int((~torch.isfinite(points)).sum()), list(points.shape)
        raise LocationError(
            f"points: expected finite positions [points, 3], got the shape {shape} with {wrong} values that are not "
            "finite",
            name="points",
            value=shape,
        )
    if directions is not None and directions.shape != points.shape:
        raise LocationError.expected(
            f"the shape of the points, {list(points.shape)}", list(directions.shape), name="directions"
        )
    if directions is not None:
        length = directions.double().norm(dim=1)
        # Not "> _UNIT": NaN is no unit vector either.
        bad = torch.nonzero(~((length - 1.0).abs() <= _UNIT)).flatten()
        if len(bad):
            row = int(bad[0])
            raise LocationError(
                f"directions, row {row}: expected a unit vector, got {directions[row].tolist()} of length "
                f"{float(length[row]):g}; divide each by its length",
                name="directions",
                row=row,
                value=float(length[row]),
            )
    fit = areas is None or (areas.shape == points.shape[:1] and bool((areas > 0).all() & torch.isfinite(areas).all()))
    if not fit:
        raise LocationError(
            f"areas: expected a number above 0 for each of {len(points)} points; leave areas out", name="areas"
        )
