"""Finders of the modes that recordings share: matrix pencils in subbands, and the paper's short-time method."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import ExtractionError
from avmsf.modal.config import ExtractionMethod
from avmsf.modal.extraction.esprit import SHORTEST, candidates
from avmsf.modal.extraction.least_squares import refine
from avmsf.modal.extraction.selection import Candidates, chance_ratio, merge, prune, select
from avmsf.modal.extraction.stft import Lines
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import noise_power

_EMPTY = ModalBank(torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
_MIN_NOISE_POWER = 1e-12
"""Least power of the noise, of sounds of mean power one: rounding of what is recorded without any."""
_LEAST_FALL = 0.3
"""A mode that falls by fewer nepers over the whole sound is not told from hum."""
_LEAST_TURN = 0.5
"""Radians by which a mode turns against half the sample rate while it falls to 1/e: with fewer its samples are all but
nothing in sine phase, and the gain of what is heard would be enormous."""
_PERIODS = 50
"""How many periods of the lowest frequency the sounds last: with fewer, a mode is not told from rumble."""


@runtime_checkable
class ModeFinder(Protocol):
    """Finds the modes that all recordings share."""

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes, by frequency; an empty bank when there are none."""
        ...


@dataclass(frozen=True)
class HighResolution:
    """Matrix pencils in subbands over all recordings, selected and refined by least squares.

    Resolves modes closer to each other than the sound's length resolves in a spectrum, such as the doublets of nearly
    round objects.
    """

    modes: int = 128
    """Maximum number of modes: those whose absence would lose most energy."""
    significance: float = 1.5
    """Energy that a mode has to explain, over the maximum that noise alone would yield anywhere."""
    range_db: float = 60.0
    """Modes this far below the strongest are left out, decibels of energy."""
    least_quality: float = 1.0
    """Minimum quality factor, pi f / d."""
    lowest_hertz: float = 0.0
    """Lowest frequency, Hz; zero for what the length of the sounds allows (about fifty periods)."""

    def __post_init__(self) -> None:
        expect_modes(self.modes)

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes of `sounds`, at most `modes` of them."""
        level = _level(sounds)
        sounds = ((sounds - sounds.mean(1, keepdim=True)) / level[:, None])[level > 0]
        samples = sounds.shape[1]
        if samples < SHORTEST or len(sounds) == 0:
            return _EMPTY
        lowest = max(self.lowest_hertz, lowest_frequency(samples, sample_rate))
        chance = chance_ratio(len(sounds), trials=samples)
        noise = noise_power(sounds, bins=noise_bins(samples)).clamp_min(_MIN_NOISE_POWER)
        pairs = candidates(sounds, noise, sample_rate=sample_rate, lowest=lowest, significance=chance)
        found = merge(*pairs, duration=samples / sample_rate)
        bank = self._prune(sounds.to(torch.float64), found, noise, sample_rate, lowest)
        # Hum and thuds are fitted beside the modes, or modes that are not there would stand in for them.
        toned = math.pi * bank.frequency > self.least_quality * bank.damping
        turning = math.pi * sample_rate - 2 * math.pi * bank.frequency > _LEAST_TURN * bank.damping
        return bank.take(toned & turning & (bank.damping >= _LEAST_FALL * sample_rate / samples))

    def _prune(
        self,
        sounds: Float64[Tensor, "contacts samples"],
        found: ModalBank,
        noise: Float[Tensor, "contacts bins"],
        sample_rate: float,
        lowest: float,
    ) -> ModalBank:
        """Return those of `found` that the sounds need, refined.

        The strong ones first, refined until little of them is left over: their remains would pass for weak modes.
        """
        samples = sounds.shape[1]
        significance = self.significance * chance_ratio(len(sounds), trials=samples)

        def weigh(bank: ModalBank) -> Candidates:
            return Candidates.of(sounds, bank, noise_at(noise, bank, sample_rate), sample_rate=sample_rate)

        def need(bank: ModalBank, range_db: float) -> ModalBank:
            return prune(
                sounds,
                bank,
                noise_at(noise, bank, sample_rate),
                sample_rate=sample_rate,
                significance=significance,
                range_db=range_db,
                count=self.modes,
            )

        weighed, bank = weigh(found), _EMPTY
        rounds = [*torch.arange(20.0, self.range_db, 20.0).tolist(), self.range_db, self.range_db]
        for turn, range_db in enumerate(rounds, 1):
            bank = select(
                weigh(bank),
                weighed,
                samples=samples,
                sample_rate=sample_rate,
                significance=significance,
                range_db=range_db,
                count=self.modes,
            )
            iterations = 20 if turn == len(rounds) else 6
            bank = refine(sounds, need(bank, range_db), sample_rate=sample_rate, iterations=iterations)
            bank = need(bank.take(bank.frequency >= lowest), range_db)
        return bank


@dataclass(frozen=True)
class ShortTime:
    """The paper's method: one candidate a bin of a short-time spectrum, log-linear decay, consensus (section 3.4).

    Times are in seconds so that they hold at any sample rate; the defaults are the paper's 2048 and 64 samples at
    44.1 kHz.
    """

    modes: int = 128
    """Maximum number of modes: those of the largest mean gain."""
    fft_seconds: float = 2048 / 44100
    """Length of the transform, rounded to a power of two in samples."""
    hop_seconds: float = 64 / 44100
    """Step between frames, rounded to a power of two in samples."""
    latest_peak: float = 0.1
    """A bin whose envelope peaks later than this after the onset holds noise, s."""
    least_damping: float = 0.5
    """A bin that decays more slowly than this is hum, 1/s."""

    def __post_init__(self) -> None:
        expect_modes(self.modes)

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes of `sounds`, at most `modes` of them."""
        return self._lines(sounds, sample_rate).modes(self.modes)

    def gains(
        self, sounds: Float[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float
    ) -> Float64[Tensor, "contacts modes"]:
        """Return the gains that the regression itself gives for a bank's modes, as `Lines.gains` does."""
        return self._lines(sounds, sample_rate).gains(bank)

    def _lines(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> Lines:
        fft_size = _power_of_two(self.fft_seconds * sample_rate, least=32)
        return Lines.of(
            sounds,
            sample_rate=sample_rate,
            fft_size=fft_size,
            hop=min(_power_of_two(self.hop_seconds * sample_rate, least=1), fft_size // 4),
            latest_peak=self.latest_peak,
            least_damping=self.least_damping,
        )


def finder_named(method: ExtractionMethod, modes: int) -> ModeFinder:
    """Return the finder of that name, of at most so many modes."""
    return HighResolution(modes=modes) if method == "high-resolution" else ShortTime(modes=modes)


def expect_modes(modes: int) -> None:
    """Raise `ExtractionError` unless at least one mode is asked for."""
    if modes < 1:
        raise ExtractionError(f"modes: expected 1 or more, got {modes}", name="modes", value=modes)


def lowest_frequency(samples: int, sample_rate: float) -> float:
    """Return the lowest frequency (Hz) at which sounds of this length let a mode be told from rumble."""
    return _PERIODS * sample_rate / samples


def _level(sounds: Float[Tensor, "contacts samples"]) -> Float[Tensor, " contacts"]:
    """Return each sound's root mean square about its mean."""
    return (sounds - sounds.mean(1, keepdim=True)).square().mean(1).sqrt()


def noise_at(
    noise: Float[Tensor, "contacts bins"], bank: ModalBank, sample_rate: float
) -> Float64[Tensor, "contacts modes"]:
    """Return the noise's power at each mode: the most of the three bins there, for its spectrum may be steep."""
    padded = torch.nn.functional.pad(noise, (1, 1))
    highest = torch.maximum(torch.maximum(padded[:, :-2], padded[:, 2:]), noise)
    place = torch.round(bank.frequency * (2 * (noise.shape[1] - 1) / sample_rate)).long()
    return highest[:, place].to(torch.float64)


def noise_bins(samples: int) -> int:
    """Return how many noise bands the length allows: of 23 Hz in 3 s at 48 kHz, wider in shorter sounds."""
    return max(16, 1 << round(math.log2(samples / 64))) // 2 + 1


def _power_of_two(value: float, *, least: int) -> int:
    return max(least, 1 << round(math.log2(max(value, 1.0))))
