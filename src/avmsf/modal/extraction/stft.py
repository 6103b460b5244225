"""The paper's extraction: one candidate mode a frequency bin, each recording on its own, then consensus (section 3.4).

The inverse short-time transform of a single bin n is a narrow-band signal whose analytic signal needs no Hilbert
transform: it is the same overlap-add without the mirror bin of negative frequency. Its envelope is therefore taken
straight from the bin's frames; it is evaluated once a hop, where nothing of so narrow a band is lost.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Float64, Int
from scipy.special import bdtrc
from torch import Tensor

from avmsf.modal.extraction.finders import ModeFinder
from avmsf.modal.modes import ModalBank

_PEAK_DB = 60.0
"""A bin whose envelope peaks this far below the loudest bin's holds no mode."""
_ABOVE_NOISE_DB = 6.0
_WINDOW_FALL = 5.0
"""How many times e a Hann window's own flank falls over its length, about."""


def narrow_band(
    sounds: Float[Tensor, "contacts samples"], *, fft_size: int, hop: int, bins: Int[Tensor, " bins"]
) -> Complex[Tensor, "contacts bins frames"]:
    """Return the analytic signal of some bins' own inverse transforms, sampled once a hop.

    `fft_size` and `hop` in samples, hop a divisor of fft_size. A steady sine of amplitude a at a bin's center has
    modulus 2a/3 there and a/6 in each of the two bins beside it: together they make up the sound (Hann window).
    """
    window = torch.hann_window(fft_size, dtype=sounds.dtype)
    frames = torch.stft(sounds, fft_size, hop, window=window, center=True, pad_mode="constant", return_complex=True)
    frames = frames[:, bins]
    reach = fft_size // hop // 2
    lags = torch.arange(-reach, reach + 1)
    weights = torch.nn.functional.pad(window, (0, 1))[fft_size // 2 + lags * hop]
    # A frame's time zero is its own beginning: at its center half the transform has passed, and one hop for each lag.
    passed = torch.remainder(bins[:, None] * (lags[None, :] * hop - fft_size // 2), fft_size)
    turns = passed.to(sounds.dtype) * (2 * math.pi / fft_size)
    kernel = torch.polar(weights.expand(len(bins), -1).contiguous(), turns)
    padded = torch.nn.functional.pad(frames, (reach, reach))
    moved = torch.zeros_like(frames)
    for position in range(len(lags)):
        moved += kernel[:, position, None].conj() * padded[..., position : position + frames.shape[-1]].contiguous()
    overlap = window.square().reshape(-1, hop).sum(0)[0]
    return moved * (2 / fft_size / overlap)


@dataclass(frozen=True, eq=False)
class Lines:
    """Straight lines fitted to the logarithms of the envelopes of all bins of all recordings (paper, eq. 5)."""

    gain: Float64[Tensor, "contacts bins"]
    """The line's value at the onset; 0 where no mode can be in the bin."""
    damping: Float64[Tensor, "contacts bins"]
    """1/s."""
    frequency: Float64[Tensor, "contacts bins"]
    """From the slope of the narrow-band signal's phase, Hz."""
    sample_rate: float
    bin_width: float
    """Distance of neighboring bins, Hz."""

    def modes(self, count: int) -> ModalBank:
        """Return up to `count` modes, the strongest of those that the recordings agree on.

        In each recording a bin is a candidate when its gain is a local maximum over bins. A mode is where the
        frequencies of candidates, in half of the recordings or more, lie closer together than chance alone would bring
        them anywhere (`_expected_by_chance`). Its damping is the mean over the recordings that show it, its frequency
        likewise. Strength is the sum of the fitted gains.
        """
        adjacent = torch.nn.functional.pad(self.gain, (1, 1))
        candidate = (self.gain >= adjacent[:, :-2]) & (self.gain > adjacent[:, 2:])
        candidate &= self.gain > self.gain.amax(1, keepdim=True) * 10 ** (-_PEAK_DB / 20)
        # The lowest bin holds the recorder's offset and the room's rumble; at half the rate a sine's samples are zero.
        candidate[:, [0, -1]] = False
        contacts, bins = torch.nonzero(candidate, as_tuple=True)
        pitch, decay, gain = (each[contacts, bins] for each in (self.frequency, self.damping, self.gain))
        nearest, distance = _nearest(pitch, contacts, len(candidate))
        distance = torch.where(distance <= self.bin_width, distance, math.inf)
        expected, reach = _expected_by_chance(distance, density=len(pitch) / (len(candidate) * self.sample_rate / 2))
        free = torch.ones_like(pitch, dtype=torch.bool)
        modes = list[tuple[float, float, float]]()
        for row in torch.argsort(expected).tolist():
            if expected[row] >= 1.0:
                break
            if free[row]:
                # Of two modes in one bin the bin shows one.
                free &= (pitch - pitch[row]).abs() > self.bin_width
                members = nearest[row][distance[row] <= reach[row]]
                weight = gain[members] / gain[members].sum()
                frequency = float((weight * pitch[members]).sum())
                modes.append((frequency, float(decay[members].mean()), float(gain[members].sum())))
        audible = [mode for mode in modes if 0 < mode[0] < self.sample_rate / 2]
        strongest = sorted(sorted(audible, key=lambda mode: -mode[2])[:count])
        table = torch.tensor(strongest, dtype=torch.float64).reshape(-1, 3)
        return ModalBank(table[:, 0].clone(), table[:, 1].clone())


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
        """Return the lines of all bins, or of some."""
        fft_size = self._fft_size(sample_rate)
        hop = min(_power_of_two(self.hop_seconds * sample_rate, least=1), fft_size // 4)
        bins = torch.arange(fft_size // 2 + 1) if bins is None else bins
        signals = (narrow_band(sound[None], fft_size=fft_size, hop=hop, bins=bins)[0] for sound in sounds)
        lines = [_regress(each, hop / sample_rate, fft_size // hop) for each in signals]
        gain, damping, advance, peak = (torch.stack(part) for part in zip(*lines, strict=True))
        # The line of a bin of noise, extended to the onset from its late peak, may start anywhere: reject before
        # ranking. An envelope that falls as fast as the window itself is the window's, not a mode's.
        ringing = (damping >= self.least_damping) & (damping < _WINDOW_FALL * sample_rate / fft_size)
        # The phase is known up to whole turns from one hop to the next: those that bring it nearest to the center.
        center, turns = bins.double() * (sample_rate / fft_size), sample_rate / hop
        frequency = center + torch.remainder(advance - center + turns / 2, turns) - turns / 2
        gain = torch.where((peak <= self.latest_peak) & ringing, gain, 0.0)
        return Lines(gain, damping, frequency, sample_rate, sample_rate / fft_size)


def _nearest(
    pitch: Float64[Tensor, " candidates"], contacts: Int[Tensor, " candidates"], count: int
) -> tuple[Int[Tensor, "candidates contacts"], Float64[Tensor, "candidates contacts"]]:
    """Return the candidate of each recording that is nearest to each candidate, and their distance, Hz."""
    rows = torch.zeros(len(pitch), count, dtype=torch.int64)
    distance = torch.full((len(pitch), count), math.inf, dtype=torch.float64)
    for contact in torch.unique(contacts).tolist():
        own = torch.nonzero(contacts == contact).flatten()
        own = own[torch.argsort(pitch[own])]
        above = torch.searchsorted(pitch[own], pitch).clamp_max(len(own) - 1)
        below = (above - 1).clamp_min(0)
        sides = torch.stack([own[below], own[above]])
        distance[:, contact], best = (pitch[sides] - pitch).abs().min(0)
        rows[:, contact] = sides.gather(0, best[None])[0]
    return rows, distance


def _expected_by_chance(
    distance: Float64[Tensor, "candidates contacts"], *, density: float
) -> tuple[Float64[Tensor, " candidates"], Float64[Tensor, " candidates"]]:
    """Return how many frequencies in all would be agreed on by chance as well as each candidate's, and how far it is.

    Candidates of noise lie anywhere, `density` a hertz and recording. That k or more of the other recordings have one
    within a distance is then binomial; taken is the k, of half of all recordings or more, that chance explains least,
    with the distance of the kth. The probability times the numbers of candidates and of choices of k is what chance is
    expected to bring about anywhere. A single recording has nothing to agree with: all of its candidates are modes.
    """
    candidates, count = distance.shape
    if count == 1 or not candidates:
        return torch.zeros(candidates, dtype=torch.float64), torch.zeros(candidates, dtype=torch.float64)
    others = torch.arange(max(1, math.ceil(0.5 * count) - 1), count)
    # Each is at distance 0 of itself.
    reach = distance.sort(1).values[:, others]
    near = -torch.expm1(-2.0 * density * reach)
    chance = torch.from_numpy(bdtrc(others.numpy() - 1, count - 1, near.numpy()))
    least, best = chance.min(1)
    return least * len(others) * candidates, reach.gather(1, best[:, None])[:, 0]


def _regress(
    signals: Complex[Tensor, "bins frames"], step: float, settling: int
) -> tuple[Float64[Tensor, " bins"], Float64[Tensor, " bins"], Float64[Tensor, " bins"], Float64[Tensor, " bins"]]:
    """Return gain, damping (1/s), frequency (Hz, up to whole turns a frame) and time of the peak (s) of every bin.

    The line log|H| = log g - d t is fitted by least squares from the envelope's peak, or `settling` frames after the
    onset, to where it has fallen by 30 dB or into its own noise. The gain is the line's value at the onset.
    """
    envelope = signals.abs().to(torch.float64).clamp_min(torch.finfo(torch.float32).tiny)
    frames = envelope.shape[-1]
    times = torch.arange(frames, dtype=torch.float64) * step
    peak = envelope.argmax(-1)
    noise = torch.kthvalue(envelope, max(1, frames // 10), dim=-1).values * 10 ** (_ABOVE_NOISE_DB / 20)
    # While the windows straddle the onset the envelope has their shape and the phase turns at the bin's own pace: the
    # line starts when they have passed, unless the mode has died by then.
    later = torch.clamp(peak, min=min(settling, frames - 1))
    sustained = envelope.gather(-1, later[:, None])[:, 0] > 2 * noise
    begin = torch.where(sustained, later, peak)[:, None]
    floor = torch.maximum(envelope.gather(-1, begin) * 10 ** (-30 / 20), noise[:, None])
    after = torch.arange(frames) >= begin
    fallen = after & (envelope < floor)
    end = torch.where(fallen.any(-1), fallen.to(torch.int8).argmax(-1), frames)
    used = (after & (torch.arange(frames) < end[:, None])).to(torch.float64)
    count = used.sum(-1)
    mean_time = (used * times).sum(-1) / count
    level = torch.log(envelope)
    mean_level = (used * level).sum(-1) / count
    spread = (used * (times - mean_time[..., None]).square()).sum(-1)
    slope = (used * (times - mean_time[..., None]) * level).sum(-1) / spread.clamp_min(step**2)
    # A line through fewer than three points says nothing.
    slope = torch.where(count >= 3, slope, 0.0)
    gain = torch.where(count >= 3, torch.exp(mean_level - slope * mean_time), 0.0)
    turn = (signals[..., 1:] * signals[..., :-1].conj() * used[..., 1:]).sum(-1)
    return gain, -slope, torch.angle(turn).to(torch.float64) / (2 * math.pi * step), peak.to(torch.float64) * step


def _power_of_two(value: float, *, least: int) -> int:
    return max(least, 1 << round(math.log2(max(value, 1.0))))
