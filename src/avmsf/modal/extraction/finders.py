"""Finders of the modes that recordings share, and the one by matrix pencils in subbands.

Which candidates are modes: forward selection by explained energy (orthogonal least squares), then removal of what the
rest explains as well.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.special import gammainccinv
from torch import Tensor

from avmsf.errors import ExtractionError
from avmsf.modal.extraction.esprit import SHORTEST, candidates
from avmsf.modal.extraction.frequency_shifts import FrequencyShifts, find_shifts
from avmsf.modal.extraction.least_squares import NormalEquations, refine
from avmsf.modal.inner_products import gram, own_gram, poles_of, project
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import noise_at, noise_bins, noise_power

_CHUNK, _SHARED = 120, 30
"""Candidates judged together, in order of frequency, and how many of them the next chunk judges again."""
_MIN_APART = 0.01
"""Least part of a mode that the others must not span: with less, gains of large and opposite modes would cancel."""
_MERGED_WIDTHS = 0.03
"""Candidates closer than this part of their width, with dampings as close, are one."""
_MIN_INDEPENDENT_AREA = 1e-6
"""Part of a candidate's (sine, cosine) area that the chosen ones must leave for it to count as another mode."""
_MAX_NEIGHBORS = 30
"""Kept candidates just below a new one among which it may find its double."""


def merge(bank: ModalBank, *, duration: float) -> ModalBank:
    """Return the candidates by frequency, without those that repeat another: nearer than they could be resolved.

    A mode's width is its damping over 2 pi, at least what `duration` seconds resolve.
    """
    bank = bank.take(torch.argsort(bank.frequency))
    ascending, rates = bank.frequency.tolist(), bank.damping.tolist()

    def repeats(row: int, other: int) -> bool:
        narrow = max(min(rates[row], rates[other]), 1 / duration) / (2 * math.pi)
        return (
            ascending[row] - ascending[other] < _MERGED_WIDTHS * narrow
            and abs(math.log(rates[row] / rates[other])) < _MERGED_WIDTHS
        )

    kept: list[int] = []
    for row in range(len(ascending)):
        if not any(repeats(row, other) for other in kept[-_MAX_NEIGHBORS:]):
            kept.append(row)
    return bank.take(torch.tensor(kept, dtype=torch.long))


def chance_ratio(contacts: int, *, trials: int) -> float:
    """Return how many times its mean the energy that a mode explains of white noise is at most, of `trials` modes.

    A mode has two amplitudes in each of the recordings, so the energy is chi-squared with twice as many degrees of
    freedom; exceeded once in ten searches by chance.
    """
    return float(gammainccinv(contacts, 0.1 / trials)) / contacts


Measured = tuple[Float64[Tensor, "contacts 2 candidates"], Float64[Tensor, "contacts candidates"]]
"""Inner products of sounds with sines and cosines, and the noise's power where each of them lies."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Decides which candidates are modes of sounds."""

    sounds: Float64[Tensor, "contacts samples"]
    noise: Float[Tensor, "contacts bins"]
    """Power of the noise in evenly spaced bands up to half the rate."""
    sample_rate: float
    significance: float
    """Energy that a mode has to explain, mean over the sounds, over what it would of noise."""
    count: int
    """Maximum number of modes."""

    def measure(self, bank: ModalBank) -> Measured:
        """Return what the sounds and their noise have to do with the modes of `bank`."""
        products, _ = project(self.sounds, poles_of(bank, self.sample_rate))
        return products.reshape(len(self.sounds), 2, len(bank)), noise_at(self.noise, bank, self.sample_rate)

    def select(self, known: ModalBank, found: ModalBank, measured: Measured, *, range_db: float) -> ModalBank:
        """Return `known` and up to `count` of `found`: those that explain most of what is left, next to each other.

        `measured` is that of `found`. A candidate counts only when what it explains is significant, and within
        `range_db` of the strongest of its neighborhood.
        """
        if len(found) == 0:
            return known
        samples, reach = self.sounds.shape[1], 10 ** (-range_db / 10)
        explained = _explained(own_gram(poles_of(found, self.sample_rate), samples), measured[0])
        energy, ratio = explained.sum(1), (explained / measured[1].T).mean(1) / 2
        # Few lie high enough for the first, coarse rounds; with all of them each would take as long as the last.
        kept = (ratio > self.significance) & (energy >= energy.amax() * reach)
        both = known.join(found.take(kept))
        order = torch.argsort(both.frequency)
        products, noise = (
            torch.cat([of_known, of_found[..., kept]], dim=-1)[..., order]
            for of_known, of_found in zip(self.measure(known), measured, strict=True)
        )
        both, given = both.take(order), order < len(known)
        energy = torch.zeros(len(both), dtype=torch.float64)
        for first in range(0, max(1, len(both) - _SHARED), _CHUNK - _SHARED):
            rows = torch.arange(first, min(len(both), first + _CHUNK))
            inner = gram(poles_of(both.take(rows), self.sample_rate), samples, power=0)
            part = products[..., rows], noise[:, rows], given[rows]
            gained = choose(inner, *part, significance=self.significance, reach=reach)
            energy[rows] = torch.maximum(energy[rows], gained)
        energy[given] = torch.inf
        most = min(self.count + len(known), int((energy > 0).sum()))
        return both.take(torch.argsort(energy, descending=True)[:most].sort().values)

    def prune(self, bank: ModalBank, *, range_db: float) -> ModalBank:
        """Return `bank` without the modes whose absence the others make up for, the `count` most needed at most.

        A mode goes when leaving it out loses nothing significant, when that loss lies `range_db` below the greatest, or
        when the others nearly span it, so that its gain would be large only to be cancelled by theirs; of neighbors
        that could stand in for each other the least needed goes first.
        """
        system = NormalEquations.of(self.sounds, poles_of(bank, self.sample_rate))
        noise, total = noise_at(self.noise, bank, self.sample_rate), torch.zeros(0, dtype=torch.float64)
        while len(bank) > 0:
            lost, apart = system.lost_without()
            ratio = (lost / noise).mean(0) / 2
            total = lost.sum(0)
            weak = (ratio < self.significance) | (total < total.max() * 10 ** (-range_db / 10)) | (apart < _MIN_APART)
            if not weak.any():
                break
            width = torch.maximum(bank.damping[:, None], bank.damping[None, :]) * (3 / (2 * math.pi))
            near = (bank.frequency[:, None] - bank.frequency[None, :]).abs() <= width
            # By index, not by value: of two that are equal only one may go.
            least = torch.where(near & weak[None, :], total[None, :], torch.inf).argmin(1)
            kept = torch.nonzero(~weak | (least != torch.arange(len(bank)))).flatten()
            bank, noise = bank.take(kept), noise[:, kept]
            system, total = system.take(kept), total[kept]
        return bank.take(torch.argsort(total, descending=True)[: self.count].sort().values)


def _explained(
    own: Float64[Tensor, "modes 2 2"], products: Float64[Tensor, "contacts 2 modes"]
) -> Float64[Tensor, "modes contacts"]:
    """Return the energy of each sound that each mode alone explains: p' G^-1 p, of two by two matrices G."""
    sine, cosine = products.permute(2, 1, 0).unbind(1)
    crossed = (own[:, 0, 1] + own[:, 1, 0])[:, None] * sine * cosine
    energy = own[:, 1, 1, None] * sine.square() - crossed + own[:, 0, 0, None] * cosine.square()
    return energy / (own[:, 0, 0] * own[:, 1, 1] - own[:, 0, 1] * own[:, 1, 0])[:, None]


def choose(
    gram: Float64[Tensor, "two_modes two_modes"],
    products: Float64[Tensor, "contacts 2 modes"],
    noise: Float64[Tensor, "contacts modes"],
    given: Bool[Tensor, " modes"],
    *,
    significance: float,
    reach: float,
) -> Float64[Tensor, " modes"]:
    """Return the energy of all sounds that each candidate explained when it was chosen, zero if never.

    The one that explains most of what the ones before it left is next, until it explains less than `reach` times what
    the best did; one that explains less than `significance` times what it would of noise, mean over the sounds, is
    never. `gram` and `products` are the inner products of all sines and then all cosines with each other and with the
    sounds, `noise` its power where each candidate lies. The `given` ones have been chosen before.
    """
    modes, contacts = len(given), len(products)
    # Each mode's sine and cosine side by side; of both remains what the chosen ones do not span.
    inner = gram.reshape(2, modes, 2, modes).permute(1, 0, 3, 2).reshape(2 * modes, 2 * modes).numpy()
    left, power = products.permute(2, 1, 0).numpy().copy(), noise.T.numpy()
    chosen, done, before = np.zeros(modes), np.zeros(modes, dtype=bool), np.flatnonzero(given).tolist()
    sine, cosine = 2 * np.arange(modes), 2 * np.arange(modes) + 1
    whole = inner[sine, sine] * inner[cosine, cosine] - inner[sine, cosine] * inner[cosine, sine]
    while not done.all():
        own, other, crossed = inner[sine, sine], inner[cosine, cosine], inner[sine, cosine] + inner[cosine, sine]
        area = own * other - inner[sine, cosine] * inner[cosine, sine]
        # What the chosen ones span already cannot be judged: only rounding is left of it.
        free = ~done & (area > _MIN_INDEPENDENT_AREA * whole)
        if before:
            best = before.pop(0)
        else:
            one, two = left[:, 0], left[:, 1]
            energy = other[:, None] * one**2 - crossed[:, None] * one * two + own[:, None] * two**2
            energy /= np.where(free, area, np.inf)[:, None]
            total = np.where((energy / power).sum(1) > 2 * contacts * significance, energy.sum(1), 0.0)
            best = int(total.argmax())
            if total[best] <= reach * chosen.max():
                break
            chosen[best] = total[best]
        done[best] = True
        if free[best]:
            pair = slice(2 * best, 2 * best + 2)
            share = np.linalg.solve(inner[pair, pair], inner[pair])
            left -= (share.T @ left[best]).reshape(left.shape)
            inner -= inner[:, pair] @ share
    return gram.new_tensor(chosen)


_EMPTY = ModalBank(torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
_MIN_NOISE_POWER = 1e-12
"""Least power of the noise, of sounds of mean power one: rounding of what is recorded without any."""
_MIN_QUALITY = 1.0
"""Least quality factor of a mode, pi f / d."""
_MIN_FALL_NEPERS = 0.3
"""A mode that falls by fewer nepers over the whole sound is not told from hum."""
_MIN_TURN_RADIANS = 0.5
"""Radians by which a mode turns against half the sample rate while it falls to 1/e: with fewer its samples are all but
nothing in sine phase, and the gain of what is heard would be enormous."""
_MIN_PERIODS = 50
"""How many periods of the lowest frequency the sounds last: with fewer, a mode is not told from rumble."""


@dataclass(frozen=True)
class ModeFinder(ABC):
    """Finds the modes that all recordings share.

    A subclass is a frozen dataclass of its settings: modes are found again where its repr has changed.
    """

    modes: int = 128
    """Maximum number of modes, the strongest as the method has it."""

    def __post_init__(self) -> None:
        if self.modes < 1:
            raise ExtractionError.expected("1 or more", self.modes, name="modes")

    @abstractmethod
    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes, at most `modes` of them, by frequency; an empty bank when there are none.

        The sounds start with the impact, all at one time, and are finite; the rate is in Hz.
        """

    def find_shifts(
        self, sounds: Float[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float
    ) -> FrequencyShifts | None:
        """Return the poles that each recording has of its own; None, as here, where all have those of `bank`."""
        return None


@dataclass(frozen=True)
class HighResolution(ModeFinder):
    """Matrix pencils in subbands over all recordings, selected and refined by least squares.

    Resolves modes closer to each other than the sound's length resolves in a spectrum, such as the doublets of nearly
    round objects. Kept are the modes whose absence would lose most energy.
    """

    significance: float = 1.5
    """Energy that a mode has to explain, over the maximum that noise alone would yield anywhere."""
    range_db: float = 60.0
    """Modes this far below the strongest are left out, decibels of energy."""

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes of `sounds`, at most `modes` of them."""
        centered = sounds - sounds.mean(1, keepdim=True)
        level = centered.square().mean(1).sqrt()
        sounds = (centered / level[:, None])[level > 0]
        samples = sounds.shape[1]
        if samples < SHORTEST or len(sounds) == 0:
            return _EMPTY
        lowest = lowest_frequency(samples, sample_rate)
        chance = chance_ratio(len(sounds), trials=samples)
        noise = noise_power(sounds, bins=noise_bins(samples)).clamp_min(_MIN_NOISE_POWER)
        found = candidates(sounds, noise, sample_rate=sample_rate, lowest=lowest, significance=chance)
        selection = Selection(sounds.double(), noise, sample_rate, self.significance * chance, self.modes)
        bank = self._select(selection, merge(found, duration=samples / sample_rate), lowest)
        # Hum and thuds are fitted beside the modes, or modes that are not there would stand in for them.
        toned = math.pi * bank.frequency > _MIN_QUALITY * bank.damping
        turning = math.pi * sample_rate - 2 * math.pi * bank.frequency > _MIN_TURN_RADIANS * bank.damping
        return bank.take(toned & turning & (bank.damping >= _MIN_FALL_NEPERS * sample_rate / samples))

    def find_shifts(
        self, sounds: Float[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float
    ) -> FrequencyShifts | None:
        """Return the poles that each recording has of its own, where modes shift from one to the next."""
        chance = chance_ratio(len(sounds), trials=sounds.shape[1])
        return find_shifts(sounds, bank, sample_rate=sample_rate, significance=self.significance * chance)

    def _select(self, selection: Selection, found: ModalBank, lowest: float) -> ModalBank:
        """Return those of `found` that the sounds need, refined."""
        measured, bank, rate = selection.measure(found), _EMPTY, selection.sample_rate
        rounds = [*torch.arange(20.0, self.range_db, 20.0).tolist(), self.range_db, self.range_db]
        for turn, range_db in enumerate(rounds, 1):
            bank = selection.prune(selection.select(bank, found, measured, range_db=range_db), range_db=range_db)
            iterations = 20 if turn == len(rounds) else 6
            bank = refine(selection.sounds, bank, sample_rate=rate, iterations=iterations)
            bank = selection.prune(bank.take(bank.frequency >= lowest), range_db=range_db)
        return bank


def lowest_frequency(samples: int, sample_rate: float) -> float:
    """Return the lowest frequency (Hz) at which sounds of this length let a mode be told from rumble."""
    return _MIN_PERIODS * sample_rate / samples
