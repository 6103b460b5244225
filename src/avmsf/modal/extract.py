"""Modes, gains and residual from recordings: one verb, two methods."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import ExtractionError
from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction import Extraction
from avmsf.modal.leastsquares import fit_gains, refine
from avmsf.modal.pencil import candidates
from avmsf.modal.residual import estimate_residual, noise_power
from avmsf.modal.selection import merge, prune, select
from avmsf.modal.shorttime import consensus_modes


class ModeFinder(Protocol):
    """Finds the modes that all recordings share."""

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes, by frequency; an empty bank when there are none."""
        ...


@dataclass(frozen=True)
class HighResolution:
    """Matrix pencils in subbands over all recordings at once, sifted and refined by least squares.

    Tells modes apart that lie closer than the sound's length resolves in a spectrum, as the doublets of nearly round
    objects do.
    """

    modes: int = 128
    """Most modes to keep: those whose absence would lose most energy."""
    significance: float = 6.0
    """How many times the energy that noise alone would yield a mode has to explain."""
    range_db: float = 60.0
    """Modes this far below the strongest are left out, decibels of energy."""
    least_quality: float = 1.0
    """Least quality factor, pi f / d: below it a thing is a thud, not a tone."""
    lowest_hertz: float = 0.0
    """Lowest frequency to look at, Hz; zero for what the length of the sounds allows (five periods)."""

    def find(self, sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> ModalBank:
        """Return the modes of `sounds`, at most `modes` of them."""
        duration = sounds.shape[1] / sample_rate
        lowest = max(self.lowest_hertz, 5 / duration)
        bank = merge(*candidates(sounds, sample_rate=sample_rate, lowest=lowest), duration=duration)
        noise = noise_power(sounds, bins=_noise_bins(sounds.shape[1], sample_rate))

        def beneath(modes: ModalBank) -> Float64[Tensor, "contacts modes"]:
            place = modes.frequency * (2 * (noise.shape[1] - 1) / sample_rate)
            floor = noise[:, place.round().long()].to(torch.float64)
            return floor.clamp_min(float(sounds.square().mean()) * 1e-12)

        found = self._toned(bank)
        bank = ModalBank(found.frequency[:0], found.damping[:0])
        # The strong modes first, refined until little of them is left over: their remains would pass for weak modes.
        for range_db in (*torch.arange(20.0, self.range_db, 20.0).tolist(), self.range_db, self.range_db):
            sifting = {"sample_rate": sample_rate, "significance": self.significance, "range_db": range_db}
            bank = select(sounds, bank, found, beneath(found), **sifting, count=self.modes)
            bank = prune(sounds, bank, beneath(bank), **sifting, count=self.modes)
            bank = self._toned(refine(sounds, bank, sample_rate=sample_rate))
            bank = prune(sounds, bank, beneath(bank), **sifting, count=self.modes)
        return bank

    def _toned(self, bank: ModalBank) -> ModalBank:
        kept = math.pi * bank.frequency > self.least_quality * bank.damping
        return ModalBank(bank.frequency[kept], bank.damping[kept])


@dataclass(frozen=True)
class ShortTime:
    """The paper's method: one candidate a bin of a short-time spectrum, log-linear decay, consensus (section 3.4).

    Times are in seconds so that they hold at any sample rate; the defaults are the paper's 2048 and 64 samples at
    44.1 kHz.
    """

    modes: int = 128
    """Most modes to keep: those of the largest mean gain."""
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
        fft_size = _power_of_two(self.fft_seconds * sample_rate, least=32)
        hop = min(_power_of_two(self.hop_seconds * sample_rate, least=1), fft_size // 4)
        return consensus_modes(
            sounds,
            sample_rate=sample_rate,
            fft_size=fft_size,
            hop=hop,
            latest_peak=self.latest_peak,
            least_damping=self.least_damping,
            count=self.modes,
        )


def extract(impacts: Impacts, method: ModeFinder | None = None) -> Extraction:
    """Return the modes that the recordings share, each recording's gains and the noise beneath (paper, section 3.4).

    `method` is `HighResolution()` unless another is given. Gains are the least-squares amplitudes of the modes over
    the whole of each sound. Raises `ExtractionError` when there are fewer than two recordings or no mode is found.
    """
    if len(impacts) < 2:
        raise ExtractionError(
            f"modes are what recordings have in common: expected at least 2 recordings, found {len(impacts)}"
        )
    return extract_sounds(impacts.sounds, sample_rate=impacts.sample_rate, method=method)


def extract_sounds(
    sounds: Float[Tensor, "contacts samples"], *, sample_rate: float, method: ModeFinder | None = None
) -> Extraction:
    """Return what `extract` does, from bare sounds that start at their onset; a single one is enough here."""
    finder = HighResolution() if method is None else method
    bank = finder.find(sounds, sample_rate)
    if len(bank) == 0:
        raise ExtractionError(_why_no_mode(sounds, sample_rate))
    gains, quadrature = fit_gains(sounds, bank, sample_rate=sample_rate)
    residual = estimate_residual(sounds, bins=_noise_bins(sounds.shape[1], sample_rate))
    return Extraction(bank, gains, residual, quadrature)


def _noise_bins(samples: int, sample_rate: float) -> int:
    """Return how many noise bands the length allows: of about 20 Hz at 44.1 kHz, wider in short sounds."""
    return _power_of_two(min(0.05 * sample_rate, samples / 8), least=16) // 2 + 1


def _power_of_two(value: float, *, least: int) -> int:
    return max(least, 1 << round(math.log2(max(value, 1.0))))


def _why_no_mode(sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> str:
    duration = sounds.shape[1] / sample_rate
    head = sounds[:, : max(1, sounds.shape[1] // 10)].square().mean()
    tail = sounds[:, -max(1, sounds.shape[1] // 10) :].square().mean()
    fall = 10 * math.log10(float(head / tail.clamp_min(1e-30)) + 1e-30)
    found = (
        f"no mode found between {5 / duration:.0f} and {sample_rate / 2:.0f} Hz in {len(sounds)} recordings of "
        f"{duration:.3g} s, whose last tenth is {fall:.0f} dB below the first"
    )
    if fall < 6:
        return f"{found}: they do not decay. Check the onset and the noise (avmsf check), or strike harder"
    if duration < 0.1:
        return f"{found}: too short for tones to stand out. Keep more seconds after the onset"
    return f"{found}: nothing rings above the noise there. Record at a higher rate, closer, or a less damped object"
