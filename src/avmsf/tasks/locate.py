"""One recording, one answer: where on the object the blow fell, or why that cannot be told."""

from dataclasses import replace
from functools import lru_cache

from avmsf._utils.arrays import ArrayLike
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import LocationError
from avmsf.field.soundfield import SoundField
from avmsf.tasks.contactmap import ContactMap
from avmsf.tasks.hearing import Sound, hear
from avmsf.tasks.locator import Locator
from avmsf.tasks.posterior import Force

STRANGE = 0.5
"""Misfit (see `ContactMap.misfit`) above which a sound is taken for another object's."""
DOUBTFUL = 0.3
"""The same, above which that is at least to be thought of."""
UNLIKE = 0.1
"""Part of a sound's energy that a blow at the likeliest place explains, below which that place is worth little."""


def locate(
    field: SoundField,
    recording: Sound,
    *,
    sample_rate: float | int | None = None,
    settings: CaptureSettings | None = None,
    points: ArrayLike | None = None,
    directions: ArrayLike | None = None,
    force: Force | None = None,
    locator: Locator | None = None,
) -> ContactMap:
    """Return where on the object a recorded impact was (paper, section Contact Localization, and a posterior).

    `recording` is the path of a sound file, a Recording, or the samples of one channel. Bare samples are at
    `sample_rate` Hz, or at the field's rate. `settings` take the place of those of the capture that the field was
    fitted to (see `hear`), `points` and `directions` as for `Locator.of`, `force` as for `Locator.locate`; `locator` is
    one made of the field before, with points of its own. That of the last field and its own points is kept, so that of
    several recordings only the first waits for it. The sound of another object has a `refusal` in place of a place, see
    `judged`. Raises LocationError as `hear` and `Locator.locate`, and for a locator of another field or given with
    points.
    """
    if locator is not None and (locator.field is not field or points is not None or directions is not None):
        what = "points or directions" if locator.field is field else "another field"
        raise LocationError(f"a locator is of one field and its points, and was given with {what}: leave it out")
    heard = hear(recording, field, sample_rate=sample_rate, settings=settings)
    if locator is None and points is None and directions is None:
        locator = _locator_of(field)
    finder = Locator.of(field, points=points, directions=directions) if locator is None else locator
    found = finder.locate(heard.sound, highest=heard.highest, force=force)
    return judged(replace(found, notes=(*heard.notes, *found.notes)))


@lru_cache(maxsize=1)
def _locator_of(field: SoundField) -> Locator:
    return Locator.of(field)


def judged(found: ContactMap) -> ContactMap:
    """Return where a blow fell, with a refusal where that cannot be told, and with a note where it is doubtful.

    A sound is refused where an object's modes do not fit it, and where the field explains its gains, over all places,
    no better than noise would. The thresholds of the misfit come of simulated plates of wood, plastic, ceramic
    and steel, a measured aircraft and a recorded bowl: their own sounds have misfits of .3 at most, as long as noise is
    no louder than they are, and 98 in 100 of others more than .5. `python -m benchmarks.locating --parts strangers`
    says what is refused of other sounds and of an object's own.
    """
    share = (
        f"the modes of this object explain {100 * found.modal:.0f} % of the sound and, put out of tune, "
        f"{100 * found.detuned:.0f} %"
    )
    if found.misfit > STRANGE:
        refusal = (
            f"{share}, a misfit of {found.misfit:.2f}; its own recordings have {DOUBTFUL:g} at most: this is "
            "another object, no blow, or mostly noise. Record it again, or choose another field"
        )
        return replace(found, refusal=refusal)
    if found.evidence <= 0.0:
        refusal = (
            f"{share}, but the field explains the strengths of its modes at no place better than noise would (log "
            f"Bayes factor {found.evidence:.1f}): this is another object, or the field has too few recordings near "
            "this place. Record it again, or fit to more recordings"
        )
        return replace(found, refusal=refusal)
    if found.misfit > DOUBTFUL:
        doubt = f"{share}, a misfit of {found.misfit:.2f}: it may be another object's, or hold much else"
    elif found.explained < UNLIKE:
        doubt = (
            f"{share}, but a blow at the likeliest place {100 * found.explained:.0f} %: the modes are not as strong in "
            "it as the field has them anywhere, so the place may well be wrong"
        )
    else:
        return found
    return replace(found, notes=(*found.notes, doubt))
