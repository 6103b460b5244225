"""All that is found out about a located blow, as plain values for programs and pages."""

from dataclasses import replace
from typing import Any

from avmsf.errors import AvmsfError
from avmsf.field.soundfield import SoundField
from avmsf.scene.symmetry import Symmetries
from avmsf.scene.symmetrysearch import find_symmetries
from avmsf.tasks.contactmap import ContactMap

LOCATED, NOT_LOCATED = "located", "not located"
"""What became of a recording."""
_JUDGED = 600
"""Points of the object in which symmetries are looked for."""
_CLOSED = 0.02
"""Part of the surface that may have its counterpart in a hole: a field's points cover their object."""


def symmetries_of(field: SoundField) -> Symmetries | None:
    """Return the symmetries of a field's points; None where these are too few to tell."""
    try:
        return find_symmetries(field.gain_field.points, seed=0, missing=_CLOSED, limit=_JUDGED)
    except AvmsfError:
        return None


def enlarged(symmetries: Symmetries, factor: float) -> Symmetries:
    """Return the symmetries of an object `factor` times as large about the origin."""
    return replace(
        symmetries,
        rotations=tuple(replace(each, point=each.point * factor) for each in symmetries.rotations),
        mirrors=tuple(replace(each, point=each.point * factor) for each in symmetries.mirrors),
        spacing=symmetries.spacing * factor,
    )


def describe_blow(contact: ContactMap, symmetries: Symmetries | None, level: float) -> dict[str, Any]:
    """Return where a blow fell, within which region with a probability of `level`, and what else fits, and why.

    Lengths in meters. Of a refused sound the status, the reason and the figures behind it. Raises LocationError for a
    level that is not between 0 and 1.
    """
    if contact.refusal is not None:
        return not_located(contact.refusal) | {
            "explained": contact.explained,
            "modes_explain": contact.modal,
            "misfit": contact.misfit,
            "log_bayes_factor": contact.evidence,
            "notes": list(contact.notes),
        }
    others = contact.counterparts(symmetries, level)
    return {
        "status": LOCATED,
        "place": contact.position.tolist(),
        "region": {
            "level": level,
            "radius_meters": contact.credible_radius(level),
            "share": float(contact.region(level).double().mean()),
        },
        "explained": contact.explained,
        "modes_explain": contact.modal,
        "misfit": contact.misfit,
        "log_bayes_factor": contact.evidence,
        "force": contact.force,
        "cosine": {
            "place": contact.points[contact.best].tolist(),
            "distance": float(contact.distance[contact.best]),
        },
        "ambiguous": bool(others),
        "counterparts": [
            {"place": other.position.tolist(), "probability": other.probability, "words": str(other)}
            for other in others
        ],
        "notes": list(contact.notes),
    }


def not_located(reason: str) -> dict[str, Any]:
    """Return the values for a recording that could not be located."""
    return {"status": NOT_LOCATED, "reason": " ".join(reason.split()), "place": None}
