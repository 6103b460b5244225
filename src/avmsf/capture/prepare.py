"""From a recording to a sound that starts at its impact and is normalized by the impact's force."""

import math
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float, Float64
from scipy.fft import irfft, next_fast_len, rfft

from avmsf.capture.audio import HIGHEST_RATE, LOWEST_RATE, MAX_PEAK, MIN_PEAK, Recording, check_not_silent
from avmsf.capture.onset import SECONDS_BEFORE, Pulse, find_onset, find_pulse
from avmsf.capture.settings import CaptureSettings

MIN_MARGIN = 16
"""Samples: an onset found by a threshold in the sound is off by one to three samples on measured objects, and the
filter that interpolates between samples needs some on either side."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """One recording from its onset on, to its end."""

    sound: Float[np.ndarray, " samples"]
    """Per newton where `newtons` is known, else as recorded."""
    before: Float[np.ndarray, " lead"]
    """What the file holds just before `sound`, in the same unit: at most `margin_length` samples."""
    onset: int
    """Sample of the file at which the impact begins, whether or not it was moved to zero."""
    pulse: Pulse | None
    """The hammer's push, where there is a force channel."""
    newtons: float | None
    """Peak force that the sound is divided by."""
    rate: float
    """The file's own sample rate, Hz."""


def prepare(recording: Recording, settings: CaptureSettings, *, newtons: float | None = None) -> Prepared:
    """Align and normalize one recording as the settings say; `newtons` is the peak force that the table gives.

    The result keeps everything after the onset; how much of it a capture keeps depends on all its recordings.
    Raises `CaptureError` for rates outside 100 Hz to 192 kHz, silence, peaks outside `MIN_PEAK` to `MAX_PEAK`, and
    normalizations that lack their force.
    """
    played = recording.sample_rate * settings.playback_speed
    if not LOWEST_RATE <= played <= HIGHEST_RATE:
        wanted = f"a sample rate of {LOWEST_RATE:g} to {HIGHEST_RATE:g} Hz (the file's rate times playback_speed)"
        raise recording.error(wanted, played, name="sample_rate", advice="export it at another rate")
    sound = recording.response(settings.response_channel, force_channel=settings.force_channel)
    check_not_silent(sound, recording)
    _check_length_and_peak(sound, recording)
    sound = remove_rumble(sound, settings.highpass, recording)
    pulse, onset = None, 0
    if settings.force_channel is not None:
        force = recording.channel(settings.force_channel)
        if np.ptp(force) == 0:
            wanted, advice = "a force in the hammer's channel", "choose another one, or remove the recording"
            raise recording.error(wanted, settings.force_channel, got="silence", name="force_channel", advice=advice)
        pulse = find_pulse(force)
        onset = pulse.start
        if newtons is None:
            newtons = abs(pulse.height * settings.force_scale)
    elif settings.align:
        onset = find_onset(sound, sample_rate=recording.sample_rate)
    normalize = settings.normalize
    if normalize == "auto":
        normalize = "none" if newtons is None else "peak"
    if normalize == "peak" and newtons is None:
        wanted, advice = 'a force for normalize = "peak"', "give force_newtons in impacts.csv, or a force_channel"
        raise recording.error(wanted, "peak", got="none", name="normalize", advice=advice)
    if normalize == "deconvolve" and pulse is not None:
        before, kept = deconvolve(sound, force, pulse=pulse, regularization=settings.regularization)
    else:
        before, kept = np.split(sound, [onset if settings.align else 0])
    if settings.from_peaks:
        whole = np.concatenate([before, kept])
        peak = int(np.argmax(np.abs(whole)))
        onset += peak - len(before)
        before, kept = np.split(whole, [peak])
    divisor = newtons if normalize in ("peak", "deconvolve") and newtons is not None else 1.0
    before, kept = before / divisor, kept / divisor
    _check_length_and_peak(kept, recording)
    before = before[max(0, len(before) - margin_length(recording.sample_rate)) :].copy()
    return Prepared(kept, before, onset, pulse, None if normalize == "none" else newtons, recording.sample_rate)


def remove_rumble(
    sound: Float64[np.ndarray, " frames"], highpass: float, recording: Recording
) -> Float64[np.ndarray, " frames"]:
    """Return the sound without what lies below `highpass` Hz: a Butterworth filter of fourth order, run both ways.

    Run both ways it moves no phase and is 6 dB down at `highpass`. Raises `CaptureError` for half the sample rate and
    above, which would leave nothing, and for a frequency without one whole period in the sound, which cannot be told
    from its offset.
    """
    if highpass == 0.0:
        return sound
    lowest, half = recording.sample_rate / len(sound), recording.sample_rate / 2
    if not lowest <= highpass < half:
        wanted = f"a highpass of 0, or {lowest:.3g} (one period in the recording) to {half:g} Hz (half its rate)"
        raise recording.error(wanted, highpass, name="highpass", advice="change it in capture.toml")
    sections = scipy.signal.butter(4, highpass, "highpass", fs=recording.sample_rate, output="sos")
    filtered: Float64[np.ndarray, " frames"] = scipy.signal.sosfiltfilt(sections, sound)
    return filtered


def shortest_allowed(rate: float) -> int:
    """Return the fewest samples in which modes can be told apart at all: 20 ms as recorded, and at least 64."""
    return max(64, math.ceil(0.02 * rate))


def margin_length(rate: float) -> int:
    """Return how many samples of each file are kept on either side of a sound, for its alignment with the others.

    20 ms as recorded, as far back as `find_onset` looks for the beginning, and at least 16 samples.
    """
    return max(MIN_MARGIN, math.ceil(SECONDS_BEFORE * rate))


def _check_length_and_peak(sound: Float64[np.ndarray, " samples"], recording: Recording) -> None:
    """Raise `CaptureError` for less than `shortest_allowed`, and for samples that float32 cannot compute with."""
    least, count, peak = shortest_allowed(recording.sample_rate), len(sound), float(np.abs(sound).max(initial=0.0))
    if count < least:
        wanted = f"at least {least} samples ({least / recording.sample_rate * 1e3:.3g} ms) after the onset"
        raise recording.error(wanted, count, name="samples", advice="record it again, or remove its row")
    if not MIN_PEAK <= peak <= MAX_PEAK:
        wanted, advice = (
            f"a peak of {MIN_PEAK:g} to {MAX_PEAK:g}",
            "export it again, or check the force it is divided by",
        )
        raise recording.error(wanted, peak, got=f"{peak:.3g}", name="peak", advice=advice)


def deconvolve(
    sound: Float64[np.ndarray, " frames"], force: Float64[np.ndarray, " frames"], *, pulse: Pulse, regularization: float
) -> tuple[Float64[np.ndarray, " lead"], Float64[np.ndarray, " samples"]]:
    """Return the response to a force of one sample's length and of the recorded pulse's height, before and from it on.

    With F and X the spectra of force over the pulse's height and of sound, zero-padded so that nothing wraps round, and
    e the regularization, the response has the spectrum

        H = X conj(F) / (|F|^2 + e max |F|^2),

    X / F where the push had energy, and zero instead of noise where it had none. Divided by the peak force in newtons,
    it is per newton for a push of one sample; times the sample rate it is per newton second. What comes before the
    push, from filters that ring ahead and from a force that is late in its channel, is at negative times, at the end of
    the transform; no more of it is returned than the sound held before the push.
    """
    # All else in the channel, an amplifier's drift and the object's ringing in the hammer, stays out of the response.
    # There is room for ringing of the recorder's filter (16 and 24 samples) and for the slow end of a soft push.
    width = pulse.stop - pulse.start
    begin = max(0, pulse.start - 16 - width)
    isolated = force[begin : min(len(force), pulse.stop + 24 + 2 * width)] - pulse.rest
    fade = min(12 + width, len(isolated))
    isolated[len(isolated) - fade :] *= np.cos(0.5 * np.pi * (np.arange(fade) + 1) / (fade + 1)) ** 2
    later = sound[begin:]
    size = next_fast_len(len(later) + len(isolated), real=True)
    push, recorded = rfft(isolated / pulse.height, size), rfft(later, size)
    power = np.abs(push) ** 2
    whole = irfft(recorded * push.conj() / (power + regularization * power.max()), size)
    # What the last samples hold of the response is the part of the push that came before its peak.
    # The zeros keep negative times, of which there are at most the window's length, apart from these.
    return whole[size - (pulse.start - begin) :], whole[: len(sound) - pulse.peak]
