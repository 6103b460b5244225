"""Where the impacts of a recording were: of one, or of several, each without the decaying sound of those before."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import scipy
import scipy.linalg
import torch
from jaxtyping import Float64
from scipy.fft import irfft, next_fast_len, rfft
from torch import Tensor

from avmsf._utils.progress import ProgressDisplay
from avmsf._utils.text import counted
from avmsf.capture.audio import check_not_silent
from avmsf.capture.onset import find_onset
from avmsf.capture.prepare import remove_rumble, shortest_allowed
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import LocationError
from avmsf.field.sound_field import SoundField
from avmsf.localization.amplitudes import Extractor
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.likelihood import Force
from avmsf.localization.locator import Locator
from avmsf.localization.preprocess import Sound, at_field_rate, location_errors, open_recording, preprocess_recording
from avmsf.modal.inner_products import poles_of
from avmsf.modal.modes import synthesize

REJECT_ABOVE = 0.5
"""Mismatch ratio (see `ContactPosterior`) above which a sound is taken for another object's."""
WARN_ABOVE = 0.3
"""The same, above which a note says that it may be."""
MIN_EXPLAINED = 0.1
"""Part of a sound's energy that an impact at the most probable position explains, below which a note is given."""
_locator_of = lru_cache(maxsize=1)(Locator.of)


def locate(
    field: SoundField,
    recording: Sound,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
    force: Force | float | int | None = None,
    locator: Locator | None = None,
    progress: bool = True,
) -> ContactPosterior:
    """Return where on the object a recorded impact was (paper, section Contact Localization, and a posterior).

    The locator of the last field, with its own points, is kept until the process ends, so that of several recordings
    only the first waits for it. `Locator.prepare` makes what the first sound needs before it comes.

    Args:
        field: The object's field.
        recording: Path of a sound file, a Recording, or the samples of one channel.
        sample_rate: Of bare samples, Hz; by default the field's.
        settings: Take the place of those of the capture that the field was fitted to (see `preprocess_recording`).
        force: Peak force of the impact, a number or `Force`, see `Locator.locate`.
        locator: One made of the field before, perhaps with points of its own; by default over the field's.
        progress: Whether a terminal shows that it works.

    Returns:
        Probability [points] of each candidate, and the most probable position, meters. The sound of another object has
            a `refusal` in place of a position, see `assess_match`.

    Raises:
        LocationError: As `preprocess_recording` and `Locator.locate`, and for a locator of another field.
    """
    with ProgressDisplay(shown=progress) as display:
        display.doing("locating the impact; the first of a field takes seconds to minutes")
        sound, highest, notes = preprocess_recording(recording, field, sample_rate=sample_rate, settings=settings)
        found = _locator_for(field, locator).locate(sound, highest=highest, force=force)
    return assess_match(replace(found, notes=(*notes, *found.notes)))


def _locator_for(field: SoundField, given: Locator | None) -> Locator:
    """Return a given locator, or the one that is kept of a field. Raises LocationError for one of another field."""
    if given is None:
        return _locator_of(field)
    if given.field is not field:
        got, advice = "one of another field", "leave it out"
        raise LocationError.expected("one of this field", "another field", got=got, name="locator", advice=advice)
    return given


def assess_match(found: ContactPosterior) -> ContactPosterior:
    """Return where an impact was, with a refusal where that cannot be found, and with a note where it is uncertain.

    A sound is rejected where an object's modes do not fit it, and where the field explains its gains, over all
    positions, no better than noise would. The thresholds of the mismatch ratio come from simulated plates of wood,
    plastic, ceramic and steel, a measured aircraft and a recorded bowl: their own sounds have ratios of .3 at most, as
    long as noise is no louder than they are, and 98 in 100 of others more than .5.
    """
    modal, null, ratio = 100 * found.modal_energy, 100 * found.null_energy, found.mismatch_ratio
    share = f"with free gains the object's modes explain {modal:.0f} % of it, modes of shifted frequencies {null:.0f} %"
    if ratio > REJECT_ABOVE:
        return found.rejected(
            f"expected a mismatch ratio of at most {WARN_ABOVE:g}, as of this object's impacts, got a mismatch ratio "
            f"of {ratio:.2f}: another object, no impact, or noise ({share}); record it again, or choose another field"
        )
    if found.evidence <= 0.0:
        return found.rejected(
            f"expected gains that the field predicts better than noise, got a log Bayes factor of {found.evidence:.1f}"
            f": another object, or too few recordings near the contact ({share}); record it again, or fit to more "
            "recordings"
        )
    if ratio > WARN_ABOVE:
        note = f"the sound may be of another object, or hold other sounds: a mismatch ratio of {ratio:.2f} ({share})"
    elif found.explained_energy < MIN_EXPLAINED:
        note = (
            "the position may be wrong: an impact at the most probable one, with the field's gains, explains "
            f"{100 * found.explained_energy:.0f} % of the sound ({share})"
        )
    else:
        return found
    return replace(found, notes=(*found.notes, note))


_GUARD_SECONDS = 0.005
"""Before an impact, left out of the fit of earlier impacts: it may begin a little earlier than its detected onset."""
_FIT_SECONDS = 0.15
"""Before an impact, to which the sound of earlier ones is fitted: longer ago it differs more from what it is then."""
_PREDICTION_SECONDS = 0.006
"""Length of the past from which linear prediction takes the next sample."""
_ONSET_RATIO, _MIN_RELATIVE_LEVEL = 4.0, 0.1
"""Level of the prediction residual at an onset, at least: over that before it, and over its largest."""


def locate_impacts(
    field: SoundField,
    recording: Sound,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
    force: Force | float | int | None = None,
    locator: Locator | None = None,
) -> list[tuple[float, ContactPosterior]]:
    """Return the onset of each impact in a recording, seconds, and its map, in order.

    Bare samples are at `sample_rate` Hz, or at the field's rate; `settings` as for `preprocess_recording`; `force`, of
    every impact, as for `locate`; `locator` is one made of the field before. The decaying sound of earlier impacts is
    fitted by the object's modes just before an impact, extrapolated and subtracted. Impacts on other objects are left
    out, which a note says, and impacts closer than 30 ms count as one. Raises LocationError as `preprocess_recording`,
    where no impact can be located, for a locator of another field, and for settings with `normalize = "deconvolve"`
    where the recording has a force channel.
    """
    whole, chosen, notes = open_recording(recording, field, sample_rate=sample_rate, settings=settings)
    if chosen.normalize == "deconvolve":
        wanted, advice = "a recording of one impact", "cut it into one recording for each impact"
        raise LocationError.expected(wanted, "deconvolve", file=whole.name, name="normalize", advice=advice)
    with location_errors():
        response = whole.response(chosen.response_channel, force_channel=chosen.force_channel)
        check_not_silent(response, whole)
        sound = remove_rumble(response, chosen.highpass, whole)
    resampled, highest, remark = at_field_rate(sound, whole, field, speed=chosen.playback_speed)
    finder = _locator_for(field, locator)
    ratio = len(resampled) / len(sound)
    # Sampled finer than it has frequencies, a sound is predicted so well that an onset seems to be before it.
    given, rate = (resampled.double().numpy(), ratio) if ratio < 1.0 else (sound, 1.0)
    onsets = [onset / rate for onset in detect_onsets(given, sample_rate=rate * whole.sample_rate)]
    starts = [round(onset * ratio) for onset in onsets]
    found = []
    rejected: list[tuple[float, LocationError]] = []
    for number, (onset, start) in enumerate(zip(onsets, starts, strict=True)):
        end = starts[number + 1] if number + 1 < len(starts) else len(resampled)
        own = resampled[start : min(end, start + field.samples)].double()
        if number:
            own = own - predict_ringing(field, resampled, starts[number - 1], start, len(own), highest=highest)
        if chosen.from_peaks:
            own = own[int(own.abs().argmax()) :]
        seconds = round(onset) / whole.sample_rate
        try:
            located = assess_match(finder.locate(own.float(), highest=highest, force=force))
            if located.refusal is not None:
                message = f"{whole.name}, impact at {seconds:.3f} s: {located.refusal}"
                raise LocationError(message, file=whole.name, name="impact", value=seconds)
        except LocationError as error:
            rejected.append((seconds, error))
            continue
        found.append((seconds, replace(located, notes=(*notes, *remark, *located.notes))))
    if not found:
        raise rejected[0][1]
    if not rejected:
        return found
    times = ", ".join(f"{seconds:.3f}" for seconds, _ in rejected)
    left_out = f"{whole.name}: {counted(len(rejected), 'impact')}, at {times} s, could not be located: {rejected[0][1]}"
    return [(seconds, replace(each, notes=(*each.notes, left_out))) for seconds, each in found]


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
    bank = field.bank.take(audible)
    values = Extractor(bank, sample_rate=rate, samples=stop - begin).extract(sound[begin:stop], color=None).values
    values = values * poles_of(bank, rate) ** (start - begin)
    return synthesize(values[None], bank.frequency, bank.damping, samples=samples, sample_rate=rate)[0]
