"""Finders of the modes that recordings share: matrix pencils in subbands, and the paper's short-time method."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.modal.config import ExtractionMethod, expect_modes
from avmsf.modal.extraction.esprit import SHORTEST, candidates
from avmsf.modal.extraction.frequency_shifts import FrequencyShifts, find_shifts
from avmsf.modal.extraction.least_squares import refine
from avmsf.modal.extraction.selection import Selection, chance_ratio, merge
from avmsf.modal.extraction.stft import Lines
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
        """Return those of `found` that the sounds need, refined.

        The strong ones first, refined until little of them is left over: their remains would pass for weak modes.
        """
        weighed, bank, rate = selection.candidates(found), _EMPTY, selection.sample_rate
        rounds = [*torch.arange(20.0, self.range_db, 20.0).tolist(), self.range_db, self.range_db]
        for turn, range_db in enumerate(rounds, 1):
            bank = selection.prune(selection.select(bank, weighed, range_db=range_db), range_db=range_db)
            iterations = 20 if turn == len(rounds) else 6
            bank = refine(selection.sounds, bank, sample_rate=rate, iterations=iterations)
            bank = selection.prune(bank.take(bank.frequency >= lowest), range_db=range_db)
        return bank


@dataclass(frozen=True)
class ShortTime(ModeFinder):
    """The paper's method: one candidate a bin of a short-time spectrum, log-linear decay, consensus (section 3.4).

    Times are in seconds so that they hold at any sample rate; the defaults are the paper's 2048 and 64 samples at
    44.1 kHz. Kept are the modes of the largest mean gain.
    """

    fft_seconds: float = 2048 / 44100
    """Length of the transform, rounded to a power of two in samples."""
    hop_seconds: float = 64 / 44100
    """Step between frames, rounded to a power of two in samples."""
    latest_peak: float = 0.1
    """A bin whose envelope peaks later than this after the onset holds noise, s."""
    least_damping: float = 0.5
    """A bin that decays more slowly than this is hum, 1/s."""

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes of `sounds`, at most `modes` of them."""
        return self._lines(sounds, sample_rate).modes(self.modes)

    def gains(
        self, sounds: Float[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float
    ) -> Float64[Tensor, "contacts modes"]:
        """Return the gain g of eq. 5 in each recording at the bins nearest to the modes: not negative, without a sign.

        It is that of the bin's narrow-band signal, two thirds of a steady sine's amplitude at most.
        """
        nearest = torch.round(bank.frequency * self._fft_size(sample_rate) / sample_rate).long()
        bins, modes = torch.unique(nearest, return_inverse=True)
        return self._lines(sounds, sample_rate, bins).gain[:, modes]

    def _fft_size(self, sample_rate: float) -> int:
        return _power_of_two(self.fft_seconds * sample_rate, least=32)

    def _lines(
        self, sounds: Float[Tensor, "contacts samples"], sample_rate: float, bins: Int[Tensor, " bins"] | None = None
    ) -> Lines:
        fft_size = self._fft_size(sample_rate)
        return Lines.of(
            sounds,
            sample_rate=sample_rate,
            fft_size=fft_size,
            hop=min(_power_of_two(self.hop_seconds * sample_rate, least=1), fft_size // 4),
            latest_peak=self.latest_peak,
            least_damping=self.least_damping,
            bins=bins,
        )


FINDERS: dict[ExtractionMethod, type[ModeFinder]] = {"high-resolution": HighResolution, "short-time": ShortTime}
"""By the names that `avmsf modes --extraction` and `PipelineConfig.extraction` take."""


def lowest_frequency(samples: int, sample_rate: float) -> float:
    """Return the lowest frequency (Hz) at which sounds of this length let a mode be told from rumble."""
    return _MIN_PERIODS * sample_rate / samples


def _power_of_two(value: float, *, least: int) -> int:
    return max(least, 1 << round(math.log2(max(value, 1.0))))
