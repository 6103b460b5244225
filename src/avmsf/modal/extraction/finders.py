"""Finders of the modes that recordings share, and the one by matrix pencils in subbands."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.modal.config import expect_modes
from avmsf.modal.extraction.esprit import SHORTEST, candidates
from avmsf.modal.extraction.frequency_shifts import FrequencyShifts, find_shifts
from avmsf.modal.extraction.least_squares import refine
from avmsf.modal.extraction.selection import Selection, chance_ratio, merge
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import noise_bins, noise_power

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
        expect_modes(self.modes)

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
