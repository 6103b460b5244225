"""A recorded impact, read like the recordings that a field was fitted to: its channel, its onset, its rate."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import scipy
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_rate, as_samples
from avmsf._utils.text import counted
from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.measure import find_clipping, prepare_single
from avmsf.capture.prepare import shortest_allowed
from avmsf.capture.preprocess import latest_start
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import ArrayError, CaptureError, LocationError
from avmsf.field.sound_field import SoundField

Sound = str | Path | Recording | ArrayLike
"""The path of a sound file, a recording, or samples alone: [samples]."""
_USABLE_BANDWIDTH = 0.9
"""Part of half a sample rate up to which a recording of another rate still holds all of a sound."""
_MAX_RATIO_TERMS = 2000
"""Largest terms of the ratio between two rates."""


def preprocess_recording(
    recording: Sound,
    field: SoundField,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
) -> tuple[Float32[Tensor, " samples"], float | None, list[str]]:
    """Prepare a recorded impact for a field like the recordings that it was fitted to.

    Returns its samples at the field's rate, from its onset on up to the next impact or the recording's end, up to which
    frequency in Hz they hold the sound (None for half that rate), and messages for the user.

    By the settings of that capture, which the field stores, or by `settings`. The impact is searched for in all of the
    recording, unless the capture was not cut and this recording starts with its impact, too. Bare samples are at
    `sample_rate` Hz, or at the field's rate, and not changed. Nothing is divided by a force, but a pulse that was
    divided out of the capture's sounds is divided out here too if the recording has it; settings of channels that the
    recording lacks are ignored. Raises LocationError for recordings that are silent, too short, not finite, or without
    a sudden rise.
    """
    whole, chosen, notes = open_recording(recording, field, sample_rate=sample_rate, settings=settings)
    with location_errors():
        prepared, second = prepare_single(whole, chosen)
        if settings is None and not field.origin.settings.align and prepared.onset < latest_start(whole.sample_rate):
            # It starts with its impact as those did that the field was fitted to, which were not cut.
            prepared, second = prepare_single(whole, replace(chosen, align=False))
    # A pulse that was divided out took the force of the impact with it.
    sound = prepared.sound if prepared.newtons is None else prepared.sound * prepared.newtons
    if second is not None:
        first, later = (each / whole.sample_rate for each in (prepared.onset, second))
        notes.append(
            f"{whole.name}: expected one impact, got more, at {first:.3f} s and at {later:.3f} s: only the first was "
            "located; --several (in Python locate_impacts) locates all"
        )
    at_rate, highest, remark = at_field_rate(sound, whole, field, speed=chosen.playback_speed)
    return at_rate, highest, [*notes, *remark]


@contextmanager
def location_errors(file: str | None = None) -> Iterator[None]:
    """Raise errors of a recording or an array, with their attributes and the file's name, as a LocationError."""
    try:
        yield
    except (ArrayError, CaptureError) as error:
        known = error if error.file is not None or file is None else error.about(Path(file))
        raise LocationError(str(known), **known.attributes) from error


def open_recording(
    recording: Sound, field: SoundField, *, sample_rate: float | int | None, settings: CaptureSettings | None
) -> tuple[Recording, CaptureSettings, list[str]]:
    """Return a recording that can be located, the settings to read it by, and messages on its faults.

    Without `settings` these are those of the field's capture, and none for bare samples. Raises CaptureError as
    `read_recording`, and LocationError for samples of more than one channel, rates that are not above 0, silence,
    samples that are not finite, for a response channel that is not there, and for what is no field.
    """
    if not isinstance(field, SoundField):
        raise LocationError.expected("a SoundField, as of avmsf.load(path)", type(field).__name__, name="field")
    if isinstance(recording, str | Path):
        recording = read_recording(Path(recording))
    time_zero = "peak" if field.origin.settings.from_peaks else "onset"
    own = replace(field.origin.settings, align=True, time_zero=time_zero)
    if not isinstance(recording, Recording):
        with location_errors():
            samples, own = as_samples(recording, "recording").double().numpy(), CaptureSettings(time_zero=time_zero)
        rate = field.sample_rate if sample_rate is None else sample_rate
        recording = Recording("the recording", samples[None], rate, "FLOAT")
    elif sample_rate is not None and sample_rate != recording.sample_rate:
        wanted, advice = f"its own sample rate, {recording.sample_rate:g} Hz", "leave sample_rate out"
        raise LocationError.expected(wanted, sample_rate, file=recording.name, name="sample_rate", advice=advice)
    with location_errors(recording.name):
        recording = replace(recording, sample_rate=as_rate(recording.sample_rate))
    check_sound(recording.channels, recording.sample_rate, file=recording.name)
    # Whatever the settings say, the field's sounds start where they do.
    given, count = own if settings is None else settings.starting(time_zero), len(recording.channels)
    force, channel = given.force_channel, given.response_channel
    # A single channel is the sound, wherever the capture has its force.
    pushed = force is not None and 1 < count >= force
    chosen = replace(
        given,
        normalize=given.normalize if given.normalize == "deconvolve" and pushed else "none",
        force_channel=force if pushed else None,
        response_channel=channel if channel is not None and channel <= count else None,
    )
    with location_errors():
        number = recording.response_channel(chosen.response_channel, force_channel=chosen.force_channel)
        clipped = find_clipping(recording.channel(number), name=recording.name)
    return recording, chosen, [] if clipped is None else [clipped]


def check_sound(
    channels: Float[np.ndarray, "channels samples"], sample_rate: float, *, file: str | None = None
) -> None:
    """Raise LocationError for a sound that is too short, not finite, or does not vary."""
    samples, least = channels.shape[1], shortest_allowed(sample_rate)
    if samples < least:
        got, advice = f"{samples} ({1e3 * samples / sample_rate:.3g} ms)", "record the impact until it has decayed"
        wanted = f"{least} samples or more"
        raise LocationError.expected(wanted, samples, got=got, file=file, name="samples", advice=advice)
    wrong = int((~np.isfinite(channels)).sum())
    if wrong:
        got = f"{wrong} samples that are not"
        raise LocationError.expected("finite", wrong, got=got, file=file, name="finite", advice="export it again")
    if not np.ptp(channels, axis=1).any():
        raise LocationError.expected("a sound", "silence", file=file, name="sound", advice="record the impact again")


def at_field_rate(
    sound: Float64[np.ndarray, " frames"], recording: Recording, field: SoundField, *, speed: float = 1.0
) -> tuple[Float32[Tensor, " samples"], float | None, list[str]]:
    """Return samples of a recording at the field's rate, up to which frequency they hold the sound, and messages.

    Raises LocationError for a rate too low for all of the object's modes.
    """
    own, rate = recording.sample_rate * speed, field.sample_rate
    if own == rate:
        return torch.from_numpy(sound.astype(np.float32)), None, []
    highest = _USABLE_BANDWIDTH * 0.5 * min(own, rate)
    frequency = field.bank.frequency
    held = int((frequency < highest).sum())
    if not held:
        lowest = f"sound at {float(frequency.min()):.4g} Hz, the lowest of the object's {len(frequency)} modes"
        got, advice = f"{own:g} Hz samples with sound up to {highest:.4g} Hz", f"record at {rate:g} Hz"
        raise LocationError.expected(lowest, own, got=got, file=recording.name, name="sample_rate", advice=advice)
    # A sound may start at its peak: a line through its ends continues it better than silence.
    ratio = Fraction(rate / own).limit_denominator(_MAX_RATIO_TERMS)
    at_rate = scipy.signal.resample_poly(sound, ratio.numerator, ratio.denominator, padtype="line")
    note = f"{recording.name} was resampled from {own:g} Hz to the field's {rate:g} Hz"
    if held < int(field.audible.sum()):
        energy = field.amplitudes.square() / field.bank.damping
        share = 100.0 * float(energy[frequency < highest].sum() / energy.sum())
        note += (
            f"; located by {held} of the object's {counted(len(frequency), 'mode')}, with {share:.0f} % of the energy "
            f"of its sounds: those above {highest:.4g} Hz are left out"
        )
    return torch.from_numpy(at_rate.astype(np.float32)), highest, [note]
