"""One recording, one answer: the contact on the object, or why it cannot be located."""

from dataclasses import replace
from functools import lru_cache

from avmsf._utils.arrays import ArrayLike
from avmsf._utils.progress import working
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import LocationError
from avmsf.field.sound_field import SoundField
from avmsf.localization.contact_map import ContactMap
from avmsf.localization.likelihood import Force
from avmsf.localization.locator import Locator
from avmsf.localization.preprocess import Sound, preprocess_recording

REJECT_ABOVE = 0.5
"""Mismatch ratio (see `ContactMap`) above which a sound is taken for another object's."""
WARN_ABOVE = 0.3
"""The same, above which a note says that it may be."""
MIN_EXPLAINED = 0.1
"""Part of a sound's energy that an impact at the most probable position explains, below which a note is given."""
SAME_FORCE = 1.41
"""Factor between a known force and the recorded one from which on a note is given: 3 dB, as `Force` is uncertain."""


def locate(
    field: SoundField,
    recording: Sound,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
    points: ArrayLike | None = None,
    directions: ArrayLike | None = None,
    force: Force | float | int | ArrayLike | None = None,
    locator: Locator | None = None,
    progress: bool = True,
) -> ContactMap:
    """Return where on the object a recorded impact was (paper, section Contact Localization, and a posterior).

    `recording` is the path of a sound file, a Recording, or the samples of one channel. Bare samples are at
    `sample_rate` Hz, or at the field's rate. `settings` take the place of those of the capture that the field was
    fitted to (see `preprocess_recording`), `points` and `directions` as for `Locator.of`. `force` is the peak force of
    the impact, a number or `Force`, see `Locator.locate`; a note says where the recording's own force channel differs.
    `locator` is one made of the field before, with points of its own. That of the last field and its own points is
    cached, so that of several recordings only the first waits for it. With `progress`, the standard error says that it
    works. The sound of another object has a `refusal` in place of a position, see `assess_match`. Raises LocationError
    as `preprocess_recording` and `Locator.locate`, and for a locator of another field or given with points.
    """
    if locator is not None and (locator.field is not field or points is not None or directions is not None):
        what = "points or directions" if locator.field is field else "another field"
        raise LocationError(
            f"locator: expected one of this field, without points and directions, got one with {what}; leave it out",
            name="locator",
            value=what,
        )
    known = None if force is None else Force.of(force)
    with working("locating the impact; the first of a field takes seconds to minutes", shown=progress):
        impact = preprocess_recording(recording, field, sample_rate=sample_rate, settings=settings)
        if locator is None and points is None and directions is None:
            locator = _locator_of(field)
        finder = Locator.of(field, points=points, directions=directions) if locator is None else locator
        found = finder.locate(impact.sound, highest=impact.highest, force=known)
    measured = measured_force_notes(impact.newtons, field, known)
    return assess_match(replace(found, notes=(*impact.notes, *measured, *found.notes)))


def measured_force_notes(newtons: float | None, field: SoundField, force: Force | None) -> tuple[str, ...]:
    """Return a note where a known force is not the one in the recording's force channel, `newtons`."""
    if force is None or not newtons or not field.origin.per_newton:
        return ()
    if 1.0 / SAME_FORCE < force.expected / newtons < SAME_FORCE:
        return ()
    return (f"expected a force of {newtons:.3g} N as in the recording's force channel, got {force.expected:.3g} N",)


@lru_cache(maxsize=1)
def _locator_of(field: SoundField) -> Locator:
    return Locator.of(field)


def assess_match(found: ContactMap) -> ContactMap:
    """Return where an impact was, with a refusal where that cannot be found, and with a note where it is uncertain.

    A sound is rejected where an object's modes do not fit it, and where the field explains its gains, over all
    positions, no better than noise would. The thresholds of the mismatch ratio come from simulated plates of wood,
    plastic, ceramic and steel, a measured aircraft and a recorded bowl: their own sounds have ratios of .3 at most, as
    long as noise is no louder than they are, and 98 in 100 of others more than .5.
    """
    modal, null, ratio = 100 * found.modal_energy, 100 * found.null_energy, found.mismatch_ratio
    share = f"with free gains the object's modes explain {modal:.0f} % of it, modes of shifted frequencies {null:.0f} %"
    if ratio > REJECT_ABOVE:
        refusal = (
            f"expected a mismatch ratio of at most {WARN_ABOVE:g}, as of this object's impacts, got a mismatch ratio "
            f"of {ratio:.2f}: another object, no impact, or noise ({share}); record it again, or choose another field"
        )
        return found.rejected(refusal)
    if found.evidence <= 0.0:
        refusal = (
            f"expected gains that the field predicts better than noise, got a log Bayes factor of {found.evidence:.1f}"
            f": another object, or too few recordings near the contact ({share}); record it again, or fit to more "
            "recordings"
        )
        return found.rejected(refusal)
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
