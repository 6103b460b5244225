"""One recording, one answer: where on the object the blow fell, or why that cannot be told."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.audio import Recording
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import LocationError
from avmsf.field.soundfield import SoundField
from avmsf.tasks.contactmap import ContactMap
from avmsf.tasks.hearing import Sound, hear
from avmsf.tasks.locator import Locator
from avmsf.tasks.posterior import Force

STRANGE = 0.35
"""Part of a sound's energy that an object's modes explain, below which the sound is taken for another object's."""
DOUBTFUL = 0.6
"""The same, below which that is at least to be thought of."""


def locate(
    field: SoundField,
    recording: Sound,
    *,
    sample_rate: float | None = None,
    settings: CaptureSettings | None = None,
    points: Float[Tensor, "points 3"] | None = None,
    directions: Float[Tensor, "points 3"] | None = None,
    force: Force | None = None,
    locator: Locator | None = None,
) -> ContactMap:
    """Return where on the object a recorded blow fell (paper, section Contact Localization, and a posterior).

    Bare samples are at `sample_rate` Hz, or at the field's rate. `settings` are those of the capture that the field was
    fitted to (see `hear`), `points` and `directions` as for `Locator.of`, `force` as for `Locator.locate`; `locator`,
    made before, saves making one for each recording. Raises LocationError as `hear` and `Locator.locate`, and for the
    sound of another object: where the modes explain less than `STRANGE` of its energy.
    """
    heard = hear(recording, field, sample_rate=sample_rate, settings=settings)
    finder = Locator.of(field, points=points, directions=directions) if locator is None else locator
    found = finder.locate(heard.sound, highest=heard.highest, force=force)
    name = recording.name if isinstance(recording, Recording) else "the recording"
    return replace(found, notes=(*heard.notes, *found.notes, *judge_fit(found, name)))


def judge_fit(found: ContactMap, name: str) -> list[str]:
    """Return a word of doubt where an object's modes explain little of a sound; LocationError where it is too little.

    The thresholds come of simulated plates and mugs: modes explain nine tenths and more of their own object's sounds
    (half where the noise is 10 dB louder), and of others', with dozens of modes each, a tenth, .3 at most.
    """
    share = f"the modes of this object explain {100 * found.modal:.0f} % of the sound"
    if found.modal < STRANGE:
        raise LocationError(
            f"{name}: {share}, and {100 * DOUBTFUL:.0f} % or more of its own recordings: this is another object, no "
            "blow, or mostly noise. Record it again, or choose another field"
        )
    return [f"{share}: it may be another object's, or hold much else"] if found.modal < DOUBTFUL else []
