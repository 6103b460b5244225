"""Noise in addition to the modes, of one color, the same at every contact (paper, section 3.4)."""

import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
import scipy.special
import torch
from jaxtyping import Float, Float64
from scipy.fft import next_fast_len
from torch import Tensor

from avmsf._utils.arrays import short_repr
from avmsf.modal.modes import ModalBank

PERIOD = 131_072
"""Samples after which the sequence repeats: 3 s at 44.1 kHz."""
MEDIAN_LEVEL = 1.054
"""Factor on the sequence with which the median of its STFT magnitudes is that of Gaussian noise of variance one."""


@cache
def white_sequence() -> Float[Tensor, " samples"]:
    """Return one period of white noise with little fluctuation of its short-time spectra, `PERIOD` samples.

    Its STFT magnitudes are near the median of those of Gaussian white noise of variance one, a little below by
    `MEDIAN_LEVEL` at their median, and its root mean square is .78 (docs/decisions/low-fluctuation-noise.md).
    Do not write into it: all callers share it.
    """
    with files(__package__).joinpath("low_fluctuation_noise.npy").open("rb") as file:
        return torch.from_numpy(np.load(file).astype(np.float32))


_REFERENCE = 1 << 17
"""Least number of samples of the white noise that the search for the quietest segments is calibrated on."""
_FINENESS = 8
"""Frequencies that each band of the residual is measured at."""
_ROUNDS = 50
"""Most steps of the search for the noise's power, each by at most two nepers."""
_CONVERGED = 1e-3
"""Step at which the search ends, nepers of power: .004 dB."""
_ROUNDING = 1e-16
"""Power of a float32 number's rounding over its square, 2^-48 / 12 to 2^-46 / 12: fainter sound is not recorded."""


@dataclass(frozen=True, eq=False)
class Residual:
    """Stationary noise by frequency band."""

    __repr__ = short_repr

    magnitude: Float[Tensor, " bins"]
    """Standard deviation of the white noise that each band is cut from (bins evenly spaced from 0 Hz to half the
    sample rate), so that all ones is white noise of unit variance. Not negative. In the unit of the recordings."""
    recordings: Float[Tensor, "contacts samples"] | None = None
    """The training recordings without their modes, if their mean over the nearest ones predicts a contact left out
    better than noise does; else None."""
    force: float | None = None
    """Force of the impact whose recording has noise of this magnitude, where it is background: whatever the force is,
    background has one level in a recording that is not divided by it. None where noise grows with the force (paper)."""


def shape_noise(
    magnitude: Float[Tensor, " bins"], *, contacts: int, samples: int, generator: torch.Generator
) -> Float[Tensor, "contacts samples"]:
    """Return white Gaussian noise filtered to `magnitude`, a fresh draw for every contact (paper, eq. 6).

    The filters b_i are triangles that sum to one, so the noise's spectrum is a white one times `magnitude`
    interpolated linearly between its bins. The white noise is drawn as its spectrum, which is white too, on the
    generator's device. Differentiable in `magnitude`.
    """
    # The next even length of small primes, on which an FFT is fast.
    length = 2 * next_fast_len((samples + 1) // 2, real=True)
    frequencies = length // 2 + 1
    options: dict[str, Any] = {"dtype": torch.complex64, "device": generator.device}
    white = torch.randn(contacts, frequencies, generator=generator, **options).to(magnitude.device)
    return torch.fft.irfft(white * interpolated(magnitude, frequencies), n=length, norm="ortho")[:, :samples]


def low_fluctuation_noise(magnitude: Float[Tensor, " bins"], *, samples: int) -> Float[Tensor, " samples"]:
    """Return the fixed `white_sequence` filtered to `magnitude` as `shape_noise` filters.

    Its STFT magnitudes are near the median of those of `shape_noise`, and its root mean square is .78 times that of
    `shape_noise`. One period is filtered circularly and repeated without a gap, so that a longer sound begins as a
    shorter one. Differentiable in `magnitude`.
    """
    sequence = white_sequence().to(magnitude)
    spectrum = torch.fft.rfft(sequence) * interpolated(magnitude, len(sequence) // 2 + 1)
    period = torch.fft.irfft(spectrum, n=len(sequence))
    return period.repeat(math.ceil(samples / len(sequence)))[:samples]


def missing_background(forces: Float[Tensor, "*contacts"], recordings: int) -> Float[Tensor, "*contacts"]:
    """Return the factor on background noise that completes it where the mean of some recordings is added.

    `forces` are relative to `Residual.force`. The mean of recordings with independent backgrounds has a background of
    their power over their number, which grows with the square of the force.
    """
    return (1.0 - forces.square() / recordings).clamp_min(0.0).sqrt()


def interpolated(magnitude: Float[Tensor, " bins"], frequencies: int) -> Float[Tensor, " frequencies"]:
    """Return the magnitude at evenly spaced frequencies from 0 Hz to half the sample rate, linear between bins."""
    place = torch.linspace(0, len(magnitude) - 1, frequencies, device=magnitude.device)
    left = place.long().clamp_max(len(magnitude) - 2)
    return torch.lerp(magnitude[left], magnitude[left + 1], (place - left).to(magnitude.dtype))


def noise_power(sounds: Float[Tensor, "contacts samples"], *, bins: int) -> Float[Tensor, "contacts bins"]:
    """Return the power of the background noise in each band of each sound: white noise of variance v gives v.

    Paper, section 3.4: the mean over the lowest-energy segments of each bin, here the tenth of them, each
    a run of half-overlapping frames, twenty runs where the sound is long enough. The quietest of anything that
    scatters lie below its mean; the result is divided by what the same search finds in white noise, of the same
    length, of variance one.
    """
    rows = max(1, _REFERENCE // sounds.shape[1])
    white = torch.randn(rows, sounds.shape[1], generator=torch.Generator().manual_seed(0)).to(sounds)
    return _quietest_power(sounds, bins=bins) / _quietest_power(white, bins=bins).mean()


def noise_bins(samples: int) -> int:
    """Return how many noise bands the length allows: of 23 Hz in 3 s at 48 kHz, wider in shorter sounds."""
    return max(16, 1 << round(math.log2(samples / 64))) // 2 + 1


def noise_at(
    noise: Float[Tensor, "contacts bins"], bank: ModalBank, sample_rate: float
) -> Float64[Tensor, "contacts modes"]:
    """Return the noise's power at each mode: the most of the three bins there, for its spectrum may be steep."""
    highest = torch.nn.functional.max_pool1d(noise, 3, stride=1, padding=1)
    place = torch.round(bank.frequency * (2 * (noise.shape[1] - 1) / sample_rate)).long()
    return highest[:, place].to(torch.float64)


def background_power(
    sounds: Float[Tensor, "contacts samples"], bank: ModalBank, sample_rate: float
) -> Float64[Tensor, "contacts modes"]:
    """Return the power of each sound's background noise at each mode, in the sounds' unit."""
    return noise_at(noise_power(sounds, bins=noise_bins(sounds.shape[1])), bank, sample_rate)


def _quietest_power(sounds: Float[Tensor, "contacts samples"], *, bins: int) -> Float[Tensor, "contacts bins"]:
    """Return the mean over the quietest tenth of the segments of each bin."""
    power = _frame_power(sounds, 2 * (bins - 1))
    count = max(1, power.shape[1] // 20)
    runs = power.shape[1] // count
    # Whole runs up to the end: the end is where a sound that dies away is quietest.
    segments = power[:, power.shape[1] - runs * count :].reshape(len(power), runs, count, -1).mean(2)
    kept = max(1, round(0.1 * runs))
    power = torch.sort(segments, dim=1).values[:, :kept].mean(1)
    # At 0 Hz and half the rate the spectrum is real and scatters twice as widely: its quietest lie too low.
    power[:, 0] = torch.maximum(power[:, 0], power[:, 1])
    power[:, -1] = torch.maximum(power[:, -1], power[:, -2])
    return power


def estimate_residual(
    sounds: Float[Tensor, "contacts samples"], modes: Float[Tensor, "contacts samples"], *, bins: int
) -> Residual:
    """Return the noise that explains the log spectra of `sounds` best, given their `modes`, row for row.

    A mode's power S and Gaussian noise of power n have E ln|mode + noise|^2 = ln n + ln x + E1(x), x = S / n (E1 is the
    exponential integral), which changes by exp(-x) with ln n. In every band n is fitted to the recorded log powers by
    least squares. Logarithms are compared because narrow lines and slow tails that the modes leave over hardly change
    their mean. For the same reason frames are an eighth of the sound, so that a band has many frequencies, and only the
    quarter of the frames count in which the modes have least energy. As frames are chosen by the modes and not by the
    noise, the choice has no bias. Of recordings with noise of unequal level the result is near the geometric mean of
    their levels. In the paper (section 3.4) the magnitudes start from the mean of each band's
    lowest-energy segments, as in `noise_power`, and are then trained.
    """
    fft_size = _FINENESS * 2 * (bins - 1)
    pairs = [_weakest_frames(sound, mode, fft_size) for sound, mode in zip(sounds, modes, strict=True)]
    recorded, ringing = (torch.cat(each) for each in zip(*pairs, strict=True))
    if not len(recorded):
        return Residual(sounds.new_zeros(bins))
    columns = torch.arange(_FINENESS * bins).view(bins, _FINENESS) - _FINENESS // 2
    # Spectra are real at 0 Hz and at half the rate, where log power has another mean.
    inside = (columns > 0) & (columns < fft_size // 2)
    columns = columns.clamp(0, fft_size // 2)
    recorded_log, ringing = torch.log(recorded[:, columns]), ringing[:, columns]
    noise = (recorded[:, columns] * inside).amax((0, 2))
    for _ in range(_ROUNDS):
        ratio = (ringing / noise[:, None]).clamp(1e-12, 1e6)
        expected = torch.log(noise)[:, None] + torch.log(ratio) + torch.from_numpy(scipy.special.exp1(ratio.numpy()))
        slope = inside * torch.exp(-ratio)
        step = (slope * (recorded_log - expected)).sum((0, 2)) / slope.square().sum((0, 2)).clamp_min(1.0)
        noise = noise * torch.exp(step.clamp(-2.0, 2.0))
        if float(step.abs().max()) < _CONVERGED:
            break
    return Residual(noise.sqrt().to(sounds.dtype))


def _weakest_frames(
    sound: Float[Tensor, " samples"], mode: Float[Tensor, " samples"], fft_size: int
) -> tuple[Float64[Tensor, "frames bins"], Float64[Tensor, "frames bins"]]:
    """Return the power of a recording and of its modes in the quarter of frames where these are weakest, bin by bin.

    Frames of digital silence, as after a noise gate or where a recording was padded, say nothing of the noise, nor do
    the frames next to them, which overlap them.
    """
    recorded, ringing = (_frame_power(each.double()[None], fft_size)[0] for each in (sound, mode))
    energy = recorded.sum(1)
    sounding = energy > _ROUNDING * energy.max()
    sounding &= torch.nn.functional.pad(sounding[1:], (0, 1), value=True)
    sounding &= torch.nn.functional.pad(sounding[:-1], (1, 0), value=True)
    recorded, ringing = recorded[sounding].clamp_min(_ROUNDING * float(recorded.max())), ringing[sounding]
    frames = min(len(ringing), max(1, round(0.25 * len(ringing))))
    weakest = torch.sort(ringing, dim=0, stable=True).indices[:frames]
    return recorded.gather(0, weakest), ringing.gather(0, weakest)


def _frame_power(sounds: Float[Tensor, "contacts samples"], fft_size: int) -> Float[Tensor, "contacts frames bins"]:
    """Return the power of half-overlapping Hann frames: white noise of variance one has one in every bin."""
    padded = torch.nn.functional.pad(sounds, (0, max(0, fft_size - sounds.shape[1])))
    window = torch.hann_window(fft_size, dtype=sounds.dtype, device=sounds.device)
    frames = padded.unfold(1, fft_size, fft_size // 2)
    spectrum = torch.fft.rfft(frames * window)
    # Faster than the square of abs(), which takes a root first.
    return (spectrum.real.square() + spectrum.imag.square()) / window.square().sum()
