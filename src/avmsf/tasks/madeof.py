"""What a field is of before an edit: what it was recast to, or what its dampings tell."""

from collections.abc import Sequence
from dataclasses import dataclass

from avmsf.errors import EditError
from avmsf.field.soundfield import SoundField
from avmsf.simulate.material import Material
from avmsf.tasks.edits import EDITS
from avmsf.tasks.materialguess import guess_materials

_CLOSE = 1.2
"""How much farther off the second-best material may be and still be as likely."""
_KEEPING = ("recast", "retune")
"""Edits that leave no doubt what a field is made of."""


@dataclass(frozen=True)
class MadeOf:
    """A material, and how it is known."""

    material: Material
    words: str
    """One sentence."""


def made_of(field: SoundField, *, option: str) -> MadeOf:
    """Return what a field is made of: what it was recast to or guessed for, or what damps as its modes do.

    `option` is what a user says the material by, for the words. Raises `EditError` where no material fits.
    """
    known = _recast_to(field.origin.report.get(EDITS, []))
    if known is not None:
        return MadeOf(known, f"the object is of {known.name}, which it was recast to before")
    report = field.origin.report
    if "guess" in report and not report.get(EDITS):
        guessed = Material(**report["material"])
        return MadeOf(guessed, f"the object is of {guessed.name}, which the field was guessed for")
    best, second, *_ = guess_materials(field.bank)
    if not best.fits:
        raise EditError(
            f"{option} is not given, and no material's damping is that of the field's modes: {best.material.name} "
            f"comes nearest, which half of them miss by a factor of {best.off:.3g} or more: say by {option} what the "
            "object is of"
        )
    close = second.off < _CLOSE * best.off
    alike = f", and {second.material.name} fits as well ({second.off:.3g}), with which the loudness would differ"
    return MadeOf(
        best.material,
        f"the object is taken to be of {best.material.name}: half of its modes have that material's damping within a "
        f"factor of {best.off:.3g}{alike if close else ''}; say {option} where you know",
    )


def _recast_to(edits: Sequence[object]) -> Material | None:
    """Return the material of the last recast, None where there is none or what followed may have changed it."""
    for entry in reversed(edits):
        kind = entry.get("edit") if isinstance(entry, dict) else None
        if kind not in _KEEPING:
            return None
        if kind == "recast":
            assert isinstance(entry, dict)
            return Material(**entry["to"])
    return None
