"""Several impacts in one recording: each is located without the decaying sound of those before."""

import math
from dataclasses import replace

import numpy as np
import scipy
import scipy.linalg
import torch
from jaxtyping import Float64
from scipy.fft import irfft, next_fast_len, rfft
from torch import Tensor

from avmsf._utils.arrays import ArrayLike
from avmsf._utils.wording import counted
from avmsf.capture.audio import Recording, refuse_silence
from avmsf.capture.onset import find_onset, find_pulse
from avmsf.capture.prepare import remove_rumble, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError, LocationError
from avmsf.field.sound_field import SoundField
from avmsf.localization.amplitudes import Extractor
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.likelihood import Force
from avmsf.localization.locate import assess_match, measured_force_notes
from avmsf.localization.locator import Locator
from avmsf.localization.preprocess import (
    Sound,
    as_recording,
    at_field_rate,
    describe,
    location_error,
    own_settings,
    read_if_path,
    settings_for,
)
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize

_GUARD_SECONDS = 0.005
"""Before an impact, left out of the fit of earlier impacts: it may begin a little earlier than its detected onset."""
_FIT_SECONDS = 0.15
"""Before an impact, to which the sound of earlier ones is fitted: longer ago it differs more from what it is then."""
_PREDICTION_SECONDS = 0.006
"""Length of the past from which linear prediction takes the next sample."""
_ONSET_RATIO, _MIN_RELATIVE_LEVEL = 4.0, 0.1
"""Level of the prediction residual at an onset, at least: over that before it, and over its largest."""
_TRAVEL_SECONDS = 0.02
"""Longest time from a push to the onset of its sound: a microphone up to 6.9 m away. Impacts are farther apart."""
_PUSH_SECONDS = 0.005
"""Longest time from the onset to the peak of the push, with a near microphone and a soft hammer."""
_MIN_PUSH_RATIO = 12.0
"""Range of the force channel around a push, at least, over the standard deviation of its noise: noise has 10 at most.
"""


def locate_impacts(
    field: SoundField,
    recording: Sound,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
    force: Force | float | int | ArrayLike | None = None,
    locator: Locator | None = None,
) -> list[tuple[float, ContactMap]]:
    """Return the onset of each impact in a recording, seconds, and its map, in order.

    Bare samples are at `sample_rate` Hz, or at the field's rate; `settings` as for `preprocess_recording`; `force`, of
    every impact, as for `locate`, is compared with the push in the force channel up to 20 ms before the onset;
    `locator` is one made of the field before. The decaying sound of earlier impacts is fitted by the object's modes
    just before an impact, extrapolated and subtracted. Impacts on other objects are left out, which a note says, and
    impacts closer than 30 ms count as one. Raises LocationError as `preprocess_recording`, where no impact can be
    located, and for settings with `normalize = "deconvolve"` where the recording has a force channel.
    """
    known = None if force is None else Force.of(force)
    recording = read_if_path(recording)
    whole = as_recording(recording, field, sample_rate=sample_rate)
    chosen = settings_for(whole, own_settings(recording, field) if settings is None else settings)
    if chosen.normalize == "deconvolve":
        raise LocationError(
            f'{whole.name}: expected a recording of one impact with normalize = "deconvolve", got several; cut it into '
            "one recording for each impact",
            file=whole.name,
            name="normalize",
            value="deconvolve",
        )
    notes = describe(whole, chosen)
    sound = _without_rumble(whole, chosen)
    onsets = detect_onsets(sound, sample_rate=whole.sample_rate)
    forces = _peak_forces(whole, onsets, chosen)
    resampled, highest, remark = at_field_rate(sound, whole, field, speed=chosen.playback_speed)
    finder = Locator.of(field) if locator is None else locator
    ratio = len(resampled) / len(sound)
    starts = [round(onset * ratio) for onset in onsets]
    found = []
    rejected: list[tuple[float, LocationError]] = []
    for number, (onset, start) in enumerate(zip(onsets, starts, strict=True)):
        end = starts[number + 1] if number + 1 < len(starts) else len(resampled)
        own = resampled[start : min(end, start + field.samples)].double()
        if number:
            own = own - predict_ringing(field, resampled, starts[number - 1], start, len(own), highest=highest)
        seconds = onset / whole.sample_rate
        try:
            located = _accepted(finder.locate(own.float(), highest=highest, force=known), whole.name, seconds)
        except LocationError as error:
            rejected.append((seconds, error))
            continue
        measured = measured_force_notes(forces[number], field, known)
        found.append((seconds, replace(located, notes=(*notes, *remark, *measured, *located.notes))))
    if not found:
        raise rejected[0][1]
    if not rejected:
        return found
    times = ", ".join(f"{seconds:.3f}" for seconds, _ in rejected)
    left_out = f"{whole.name}: {counted(len(rejected), 'impact')}, at {times} s, could not be located: {rejected[0][1]}"
    return [(seconds, replace(each, notes=(*each.notes, left_out))) for seconds, each in found]


def _accepted(found: ContactMap, recording: str, seconds: float) -> ContactMap:
    """Return the map of the impact at `seconds`, see `assess_match`; raises LocationError for one on another object."""
    located = assess_match(found)
    if located.refusal is not None:
        raise LocationError(
            f"{recording}, impact at {seconds:.3f} s: {located.refusal}", file=recording, name="impact", value=seconds
        )
    return located


def _without_rumble(recording: Recording, settings: CaptureSettings) -> Float64[np.ndarray, " frames"]:
    """Return the channel of the sound, high-pass filtered; raises LocationError where it cannot be used."""
    try:
        response = recording.response(settings.response_channel, force_channel=settings.force_channel)
        refuse_silence(response, recording.name)
        return remove_rumble(response, settings.highpass, recording)
    except CaptureError as error:
        raise location_error(error) from error


def _peak_forces(recording: Recording, onsets: list[int], settings: CaptureSettings) -> list[float | None]:
    """Return the peak force of each impact by the recording's force channel; None without a push above the noise.

    The push is searched from `_TRAVEL_SECONDS` before the onset of the sound to `_PUSH_SECONDS` after it.
    """
    if settings.force_channel is None:
        return [None] * len(onsets)
    force = recording.channel(settings.force_channel)
    before, after = (round(seconds * recording.sample_rate) for seconds in (_TRAVEL_SECONDS, _PUSH_SECONDS))
    parts = [force[max(0, onset - before) : onset + after] for onset in onsets]
    # From the 90 % quantile of Gaussian noise: pushes take less than a tenth of the time.
    limit = _MIN_PUSH_RATIO / 1.645 * float(np.quantile(np.abs(force - np.median(force)), 0.9))
    return [abs(find_pulse(part).height * settings.force_scale) if np.ptp(part) > limit else None for part in parts]


def detect_onsets(sound: Float64[np.ndarray, " frames"], *, sample_rate: float) -> list[int]:
    """Return the onsets of impacts, samples, in order, at least 30 ms apart; where none is sudden, the most likely one.

    Free decay follows from its own past, an impact does not. So the sound is predicted linearly from the samples before
    (one set of weights, by its autocorrelation). An onset is where the residual's root mean square over 2 ms is
    `_ONSET_RATIO` times that of the 25 ms before, and at least `_MIN_RELATIVE_LEVEL` of the largest.
    """
    error = _prediction_residual(sound, round(_PREDICTION_SECONDS * sample_rate))
    short, past, apart = (max(4, round(seconds * sample_rate)) for seconds in (0.002, 0.025, 0.03))
    power = np.concatenate([[0.0], np.cumsum(error**2)])
    level = np.sqrt((power[short:] - power[:-short]) / short)
    floor = _MIN_RELATIVE_LEVEL * level.max()
    onsets: list[int] = []
    place = 0
    while place < len(level):
        # The beginning of the impact itself is not its past.
        begin, end = max(0, place - past), max(0, place - short)
        if onsets:
            begin = max(begin, min(onsets[-1] + 2 * short, end - short))
        before = math.sqrt(max(power[end] - power[begin], 0.0) / (end - begin)) if end - begin >= short else 0.0
        if level[place] < floor or level[place] < _ONSET_RATIO * before:
            place += 1
            continue
        window = np.abs(error[place : place + 2 * short])
        onsets.append(place + int(np.argmax(window >= 0.25 * window.max())))
        place = onsets[-1] + apart
    least = shortest_allowed(sample_rate)
    kept = [onset for onset in onsets if len(sound) - onset >= least]
    return kept or [find_onset(sound, sample_rate=sample_rate)]


def _prediction_residual(sound: Float64[np.ndarray, " frames"], order: int) -> Float64[np.ndarray, " frames"]:
    """Return the residual of each sample's linear prediction from the `order` samples before it."""
    order = max(8, min(order, len(sound) // 8))
    size = next_fast_len(len(sound) + order + 1, real=True)
    correlation = irfft(np.abs(rfft(sound, size)) ** 2, size)[: order + 1]
    # As if there were noise 70 dB down: without any, the weights follow rounding.
    correlation[0] *= 1.0 + 1e-7
    weights = scipy.linalg.solve_toeplitz(correlation[:-1], correlation[1:])
    predicted = scipy.signal.fftconvolve(sound, weights)[: len(sound) - 1]
    return sound - np.concatenate([[0.0], predicted])


def predict_ringing(
    field: SoundField, sound: Tensor, last: int, start: int, samples: int, *, highest: float | None
) -> Float64[Tensor, " samples"]:
    """Return the sound from sample `start` on of the impact that began at sample `last`, by the object's modes."""
    rate = field.sample_rate
    stop = start - min(round(_GUARD_SECONDS * rate), (start - last) // 4)
    begin = max(last, stop - round(_FIT_SECONDS * rate))
    audible = torch.nonzero(field.bank.frequency < min(0.5 * rate, highest or 0.5 * rate)).flatten()
    bank = ModalBank(field.bank.frequency[audible], field.bank.damping[audible])
    extractor = Extractor.of(bank, sample_rate=rate, samples=stop - begin)
    values = extractor.extract(sound[begin:stop], color=None).values
    seconds = (start - begin) / rate
    values = values * torch.polar(torch.exp(-bank.damping * seconds), 2.0 * torch.pi * bank.frequency * seconds)
    return synthesize(
        values.real[None],
        bank.frequency,
        bank.damping,
        samples=samples,
        sample_rate=rate,
        quadrature=values.imag[None],
    )[0]
