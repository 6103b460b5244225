"""When an impact begins, in a force channel or in a sound, and whether a second one follows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

SECONDS_BEFORE = 0.02
"""How long before its first strong swing a sound may have begun, seconds."""
FORCE_OF_SECOND_IMPACT = 0.15
"""Share of the first pulse's peak above which another push counts as a second impact."""
ENERGY_OF_SECOND_IMPACT = 10**-2.6
"""Share of the first impact's energy that a second one must bring: -26 dB."""
RISE_OF_SECOND_IMPACT = 10**0.6
"""Ratio of energy after to energy before that a second impact must reach in the median bin: 6 dB."""


@dataclass(frozen=True)
class Pulse:
    """One push of a hammer, in samples of its channel."""

    start: int
    """First sample of the rise."""
    peak: int
    """Sample of the greatest force."""
    stop: int
    """First sample after the fall."""
    height: float
    """Force at the peak above the channel's resting level, in the channel's unit; the sign is the wiring's."""
    rest: float
    """The channel's resting level: its median before the push, or over all of it where that is under 64 samples."""


def find_pulse(force: Float64[np.ndarray, " frames"]) -> Pulse:
    """Find the first push at least half as strong as the strongest.

    A hammer's pulse stands far above everything else in its channel, so its flanks are simply where the force falls
    below a tenth of the peak. The channel must not be constant.
    """
    rest = float(np.median(force))
    above = force - rest
    sign = 1.0 if above.max() >= -above.min() else -1.0
    above = sign * above
    first = int(np.argmax(above >= 0.5 * above.max()))
    peak = first + int(np.argmax(above[first : first + _run(above[first:] >= 0.5 * above[first])]))
    high = above >= 0.1 * above[peak]
    start = peak + 1 - _run(high[peak::-1])
    stop = peak + _run(high[peak:])
    if start >= 64:  # an amplifier may drift after the push, so rest is best seen before it
        rest = float(np.median(force[:start]))
    return Pulse(start, peak, stop, float(force[peak]) - rest, rest)


def find_second_push(
    force: Float64[np.ndarray, " frames"], pulse: Pulse, *, sample_rate: float, seconds: float
) -> int | None:
    """Return the sample at which the hammer touched again within `seconds` of the first touch, or None.

    Only pushes of the pulse's own sign count, and none closer than 2 ms or 8 samples to it: a pulse near the
    bandwidth of the recorder is followed by ringing of the anti-alias filter.
    """
    begin = pulse.stop + max(8, round(0.002 * sample_rate))
    later = (force[begin : pulse.start + round(seconds * sample_rate)] - pulse.rest) / pulse.height
    touches = np.flatnonzero(later > FORCE_OF_SECOND_IMPACT)
    return begin + int(touches[0]) if len(touches) else None


def find_onset(sound: Float64[np.ndarray, " frames"], *, sample_rate: float) -> int:
    """Return the sample at which the first strong impact departs from the noise before it.

    The loudest sample will not do: where modes beat it comes milliseconds after the impact, by another amount for each
    contact, and shifts the modes' phases from one recording to the next. So the first swing to half the peak is found,
    and then the first sample within 20 ms before it that exceeds both a tenth of the peak and five times the noise
    (root mean square of all that lies earlier still). Of several impacts, the first that reaches half the loudest
    counts.
    """
    level = np.abs(sound - np.median(sound))
    peak = level.max()
    swing = int(np.argmax(level >= 0.5 * peak))
    begin = max(0, swing - round(SECONDS_BEFORE * sample_rate))
    noise = float(np.sqrt(np.mean(level[:begin] ** 2))) if begin >= 64 else 0.0
    threshold = min(max(0.1 * peak, 5 * noise), 0.5 * peak)
    return begin + int(np.argmax(level[begin : swing + 1] >= threshold))


def find_second_impact(
    sound: Float64[np.ndarray, " frames"], onset: int, *, sample_rate: float, seconds: float
) -> int | None:
    """Return the sample, within half a window, at which the object was struck again within `seconds`, or None.

    An impact excites all modes at once, where beating doublets raise a few: so in windows of 10 ms (at least 64
    samples) the median rise over the bins that the first impact excited (to within 20 dB of the strongest), against the
    loudest of the three windows before, must reach 6 dB; and the energy that comes new into these bins must be more
    than -26 dB of the first impact's, for a clack of the hammer's handle or a noise in the room lies between the modes.
    A bounce within two windows of the first touch is not told from it: that takes a force channel.
    """
    size = max(64, round(0.01 * sample_rate))
    hop = size // 4
    kept = sound[onset : onset + round(seconds * sample_rate)]
    if len(kept) < 4 * size:
        return None
    frames = np.lib.stride_tricks.sliding_window_view(kept, size)[::hop]
    power = np.abs(np.fft.rfft(frames * np.hanning(size), axis=1)) ** 2
    first = power[:5].max(axis=0)
    # A single sample at the onset, before digital silence, lies where the window is zero.
    if not first.any():
        return None
    excited = first > 1e-2 * first.max()
    power, first = power[:, excited], first[excited]
    floor = 1e-10 * first.max()
    for frame in range(8, len(power)):
        before = power[max(0, frame - 16) : frame - 3].max(axis=0)
        rise = np.median((power[frame] + floor) / (before + floor))
        brought = np.maximum(power[frame] - before, 0).sum() / first.sum()
        if rise > RISE_OF_SECOND_IMPACT and brought > ENERGY_OF_SECOND_IMPACT:
            return onset + frame * hop + size // 2
    return None


def _run(flags: np.ndarray) -> int:
    """Count the leading true values."""
    return int(np.argmin(flags)) if not flags.all() else len(flags)
