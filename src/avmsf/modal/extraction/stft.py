"""The paper's extraction: one candidate mode a frequency bin, each recording on its own, then consensus (section 3.4).

The inverse short-time transform of a single bin n is a narrow-band signal whose analytic signal needs no Hilbert
transform: it is the same overlap-add without the mirror bin of negative frequency. Its envelope is therefore taken
straight from the bin's frames; it is evaluated once a hop, where nothing of so narrow a band is lost.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex, Float, Float64, Int
from torch import Tensor

from avmsf.modal.modes import ModalBank

_PEAK_DB = 60.0
"""A bin whose envelope peaks this far below the loudest bin's holds no mode."""
_REGRESSED_DB = 30.0
"""The line is fitted to the envelope's first fall by this much, or down to the bin's own noise."""
_ABOVE_NOISE_DB = 6.0
_WINDOW_FALL = 5.0
"""How many times e a Hann window's own flank falls over its length, about."""
_CONSENSUS = 0.5
"""A frequency belongs to the object when at least this part of the recordings shows it, one bin off at most."""


def narrow_band(
    sounds: Float[Tensor, "contacts samples"], *, fft_size: int, hop: int, bins: Int[Tensor, " bins"] | None = None
) -> Complex[Tensor, "contacts bins frames"]:
    """Return the analytic signal of every bin's own inverse transform, or of some bins', sampled once a hop.

    `fft_size` and `hop` in samples, hop a divisor of fft_size. A steady sine of amplitude a at a bin's center has
    modulus 2a/3 there and a/6 in each of the two bins beside it: together they make up the sound (Hann window).
    """
    window = torch.hann_window(fft_size, dtype=sounds.dtype)
    frames = torch.stft(sounds, fft_size, hop, window=window, center=True, pad_mode="constant", return_complex=True)
    if bins is None:
        bins = torch.arange(fft_size // 2 + 1)
    else:
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

    @classmethod
    def of(
        cls,
        sounds: Float[Tensor, "contacts samples"],
        *,
        sample_rate: float,
        fft_size: int,
        hop: int,
        latest_peak: float,
        least_damping: float,
        bins: Int[Tensor, " bins"] | None = None,
    ) -> "Lines":
        """Fit the lines of all bins, or of some.

        No mode can be in a bin whose envelope peaks later than `latest_peak` seconds after the onset, or falls by less
        than `least_damping` 1/s, or as fast as the window.
        """
        lines = [
            _regress(
                narrow_band(sound[None], fft_size=fft_size, hop=hop, bins=bins)[0], hop / sample_rate, fft_size // hop
            )
            for sound in sounds
        ]
        gain, damping, advance, peak = (torch.stack(part) for part in zip(*lines, strict=True))
        # The line of a bin of noise, extended to the onset from its late peak, may start anywhere: reject before
        # ranking. An envelope that falls as fast as the window itself is the window's, not a mode's.
        ringing = (damping >= least_damping) & (damping < _WINDOW_FALL * sample_rate / fft_size)
        # The phase is known up to whole turns from one hop to the next: those that bring it nearest to the center.
        numbers = torch.arange(gain.shape[1]) if bins is None else bins
        center = numbers.double() * (sample_rate / fft_size)
        turns = sample_rate / hop
        frequency = center + torch.remainder(advance - center + turns / 2, turns) - turns / 2
        return cls(torch.where((peak <= latest_peak) & ringing, gain, 0.0), damping, frequency, sample_rate)

    def modes(self, count: int) -> ModalBank:
        """Return up to `count` modes, the strongest of those that the recordings agree on.

        In each recording a bin is a candidate when its gain is a local maximum over bins. A mode's damping is the mean
        over the recordings that show it, its frequency likewise. Strength is the mean fitted gain.
        """
        gain = self.gain
        adjacent = torch.nn.functional.pad(gain, (1, 1))
        candidate = (gain >= adjacent[:, :-2]) & (gain > adjacent[:, 2:])
        candidate &= gain > gain.amax(1, keepdim=True) * 10 ** (-_PEAK_DB / 20)
        # The lowest bin holds the recorder's offset and the room's rumble.
        candidate[:, 0] = False
        return self._agreed(candidate, count)

    def _agreed(self, candidate: Bool[Tensor, "contacts bins"], count: int) -> ModalBank:
        once = candidate.to(torch.float64)
        near = once + _neighbors(once)
        shown, votes = near.clamp_max(1.0).sum(0), near.sum(0)
        before, after = (torch.nn.functional.pad(votes, sides) for sides in ((1, 0), (0, 1)))
        best = (votes >= before[:-1]) & (votes > after[1:])
        bins = torch.nonzero(best & (shown >= max(1.0, _CONSENSUS * len(candidate)))).flatten()

        def mean(values: Float64[Tensor, "contacts bins"], weight: Float64[Tensor, "contacts bins"]) -> Tensor:
            total, share = ((part + _neighbors(part)).sum(0)[bins] for part in (weight * values, weight))
            return total / share

        pitch, decay = mean(self.frequency, once * self.gain), mean(self.damping, once)
        strength = mean(self.gain, once) * shown[bins]
        audible = torch.nonzero((pitch > 0) & (pitch < self.sample_rate / 2)).flatten()
        strongest = audible[torch.argsort(strength[audible], descending=True)[:count]]
        order = strongest[torch.argsort(pitch[strongest])]
        return ModalBank(pitch[order], decay[order])


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
    floor = torch.maximum(envelope.gather(-1, begin) * 10 ** (-_REGRESSED_DB / 20), noise[:, None])
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


def _neighbors(values: Float64[Tensor, "contacts bins"]) -> Float64[Tensor, "contacts bins"]:
    padded = torch.nn.functional.pad(values, (1, 1))
    return padded[:, :-2] + padded[:, 2:]
