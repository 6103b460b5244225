"""A recorded blow as the recordings were that a field was fitted to: its channel, its onset, its rate."""

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import scipy.signal
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_floats
from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.blow import clipping, expect_sudden
from avmsf.capture.onset import Pulse, find_second_blow, find_second_push
from avmsf.capture.prepare import prepare, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.starts import latest_start
from avmsf.errors import CaptureError, LocationError
from avmsf.field.soundfield import SoundField

Sound = str | Path | Recording | ArrayLike
"""The path of a sound file, a recording, or samples alone: [samples]."""
_HELD = 0.9
"""Part of half a sample rate up to which a recording of another rate still holds all of a sound."""
_FINEST = 2000
"""Largest terms of the ratio between two rates."""


@dataclass(frozen=True, eq=False)
class Heard:
    """One blow, prepared."""

    sound: Float32[Tensor, " samples"]
    """From its onset on, at the field's rate, up to the next blow or the recording's end."""
    onset: int
    """Sample of the recording at which the blow begins, at the recording's own rate."""
    highest: float | None
    """Frequency in Hz up to which the recording holds the sound; None where that is half the field's rate."""
    notes: tuple[str, ...]
    """What a user should know, in sentences."""


def hear(
    recording: Sound,
    field: SoundField,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
) -> Heard:
    """Prepare a recorded blow for a field as the recordings were that it was fitted to.

    By the settings of that capture, which the field keeps, but that the blow is sought wherever it begins, unless the
    capture was not cut and this recording starts with its impact, too; `settings` take their place. Bare samples are at
    `sample_rate` Hz, or at the field's rate, and taken as they are. Nothing is divided by a force, but a pulse that was
    divided out of the capture's sounds is divided out here too where the recording holds it; channels that the
    recording lacks are not asked for. Raises LocationError for recordings that are silent, too short, not finite, or
    never sudden enough to hold a blow.
    """
    recording = read_if_path(recording)
    whole = as_recording(recording, field, sample_rate=sample_rate)
    chosen = settings_for(whole, own_settings(recording, field) if settings is None else settings)
    notes = describe(whole, chosen)
    try:
        prepared = prepare(whole, chosen)
        if settings is None and not field.origin.settings.align and prepared.onset < latest_start(whole.sample_rate):
            # It starts with its impact as those did that the field was fitted to, which were not cut.
            prepared = prepare(whole, replace(chosen, align=False))
        # Of one channel all is heard, the quiet before the blow too.
        heard = whole.response() if len(whole.channels) == 1 else prepared.sound
        expect_sudden(heard, sample_rate=whole.sample_rate, name=whole.name)
    except CaptureError as error:
        raise LocationError(str(error)) from error
    # A pulse that was divided out took the force with it, which says how hard the blow was.
    sound = prepared.sound if prepared.newtons is None else prepared.sound * prepared.newtons
    begin = prepared.onset if chosen.align else 0
    second = _second(whole, sound, begin, prepared.pulse, chosen)
    if second is not None:
        rate = whole.sample_rate
        notes.append(
            f"{whole.name} holds more than one blow, at {prepared.onset / rate:.3f} s and at {second / rate:.3f} s: "
            "only the first was located; --several, in Python locate_blows, takes them all"
        )
        sound = sound[: max(second - begin, shortest_allowed(rate))]
    at_rate, highest, remark = at_field_rate(sound, whole, field, speed=chosen.playback_speed)
    return Heard(at_rate, prepared.onset, highest, (*notes, *remark))


def read_if_path(recording: Sound) -> Recording | ArrayLike:
    """Return a recording as it is, or read it from its path. Raises CaptureError as `read_recording`."""
    return read_recording(Path(recording)) if isinstance(recording, str | Path) else recording


def as_recording(
    recording: Recording | ArrayLike, field: SoundField, *, sample_rate: float | int | None = None
) -> Recording:
    """Return a recording that can be listened to.

    Raises LocationError for samples of more than one channel, rates that are none, silence and what is not finite.
    """
    if not isinstance(recording, Recording):
        samples = as_floats(recording, "recording").double().numpy()
        if samples.ndim != 1:
            raise LocationError(
                f"expected the samples of one channel, found the shape {samples.shape}: give one row or column of it, "
                "or a Recording"
            )
        rate = field.sample_rate if sample_rate is None else sample_rate
        recording = Recording("the recording", samples[None], rate, "FLOAT")
    elif sample_rate is not None and sample_rate != recording.sample_rate:
        raise LocationError(
            f"{recording.name} is at {recording.sample_rate:g} Hz and sample_rate says {sample_rate:g} Hz: leave "
            "sample_rate out, a recording knows its own"
        )
    if not (math.isfinite(recording.sample_rate) and recording.sample_rate > 0.0):
        raise LocationError(f"{recording.name} is at {recording.sample_rate:g} Hz: expected a sample rate above 0")
    channels = recording.channels
    least = shortest_allowed(recording.sample_rate)
    if recording.frames < least:
        raise LocationError(
            f"{recording.name} is too short, {recording.frames} samples "
            f"({1e3 * recording.duration:.3g} ms), expected at least {least}: record the blow until it has died away"
        )
    if not np.isfinite(channels).all():
        raise LocationError(
            f"{recording.name}: {int((~np.isfinite(channels)).sum())} samples are not finite numbers: export it again"
        )
    if not np.ptp(channels, axis=1).any():
        raise LocationError(f"{recording.name} is silent: record the blow again")
    return recording


def describe(recording: Recording, settings: CaptureSettings) -> list[str]:
    """Return what is wrong with a recording that can be listened to nevertheless."""
    try:
        response = recording.response(settings.response_channel, force_channel=settings.force_channel)
    except CaptureError as error:
        raise LocationError(str(error)) from error
    clipped = clipping(response, name=recording.name)
    return [] if clipped is None else [clipped]


def at_field_rate(
    sound: Float64[np.ndarray, " frames"], recording: Recording, field: SoundField, *, speed: float = 1.0
) -> tuple[Float32[Tensor, " samples"], float | None, list[str]]:
    """Return samples of a recording at the field's rate, up to which frequency they hold the sound, and words about it.

    Raises LocationError for a rate at which nothing of the object's modes is held.
    """
    own, rate = recording.sample_rate * speed, field.sample_rate
    if own == rate:
        return torch.from_numpy(sound.astype(np.float32)), None, []
    highest = _HELD * 0.5 * min(own, rate)
    frequency = field.bank.frequency
    held = int((frequency < highest).sum())
    if not held:
        raise LocationError(
            f"{recording.name} is at {own:g} Hz and holds sound up to {highest:.4g} Hz, and the lowest of the object's "
            f"{len(frequency)} modes is at {float(frequency.min()):.4g} Hz: record at {rate:g} Hz"
        )
    ratio = Fraction(rate / own).limit_denominator(_FINEST)
    resampled = scipy.signal.resample_poly(sound, ratio.numerator, ratio.denominator, padtype="line")
    note = f"{recording.name} was resampled from {own:g} Hz to the field's {rate:g} Hz"
    left_out = int((frequency < 0.5 * rate).sum()) - held
    if left_out:
        note += f"; {left_out} of the object's {len(frequency)} modes, above {highest:.4g} Hz, were left out"
    return torch.from_numpy(resampled.astype(np.float32)), highest, [note]


def own_settings(recording: Recording | ArrayLike, field: SoundField) -> CaptureSettings:
    """Return the settings by which a field's own capture was read; bare samples are read already."""
    return replace(field.origin.settings, align=True) if isinstance(recording, Recording) else CaptureSettings()


def settings_for(recording: Recording, settings: CaptureSettings) -> CaptureSettings:
    """Return settings that ask for nothing which a recording of a single blow may lack."""
    count = len(recording.channels)
    force, response = settings.force_channel, settings.response_channel
    kept = replace(
        settings,
        normalize="none",
        # A single channel is the sound, wherever the capture has its force.
        force_channel=force if force is not None and count > 1 and force <= count else None,
        response_channel=response if response is not None and response <= count else None,
    )
    if settings.normalize == "deconvolve" and kept.force_channel is not None:
        return replace(kept, normalize="deconvolve")
    return kept


def _second(
    recording: Recording,
    sound: Float64[np.ndarray, " samples"],
    begin: int,
    pulse: Pulse | None,
    settings: CaptureSettings,
) -> int | None:
    """Return the sample of the recording at which a second blow begins, if there is one."""
    rate, seconds = recording.sample_rate, len(sound) / recording.sample_rate
    if pulse is not None and settings.force_channel is not None:
        force = recording.channel(settings.force_channel)
        return find_second_push(force, pulse, sample_rate=rate, seconds=seconds)
    second = find_second_blow(sound, 0, sample_rate=rate, seconds=seconds)
    return None if second is None else begin + second
