"""The material of a field before an edit: that of its last material edit, or the one nearest to its dampings."""

from collections.abc import Sequence
from dataclasses import dataclass

from avmsf.errors import EditError
from avmsf.field.soundfield import SoundField
from avmsf.simulate.material import Material
from avmsf.tasks.edits import EDITS
from avmsf.tasks.materialguess import guess_materials

_CLOSE = 1.2
"""Ratio of the errors up to which the second-best material is as likely."""
_KEEPING = ("change_material", "adjust_modes")
"""Edits after which a field's material is known."""


@dataclass(frozen=True)
class MadeOf:
    """A material, and how it is known."""

    material: Material
    words: str
    """The message."""


def made_of(field: SoundField, *, option: str) -> MadeOf:
    """Return a field's material: that of its last material edit or of its guess, or the one nearest to its dampings.

    `option` is the option for the material, named in messages. Raises `EditError` where no material fits.
    """
    known = _changed_to(field.origin.report.get(EDITS, []))
    if known is not None:
        return MadeOf(known, f"old material: {known.name}, from the last material edit")
    report = field.origin.report
    if "guess" in report and not report.get(EDITS):
        guessed = Material(**report["material"])
        return MadeOf(guessed, f"old material: {guessed.name}, for which the field was guessed")
    best, second, *_ = guess_materials(field.bank)
    if not best.fits:
        raise EditError(
            f"expected {option}, got none, and no material has the dampings of the modes: the nearest, "
            f"{best.material.name}, differs by a median factor of {best.off:.3g}; give {option}",
            name=option,
            value=best.material.name,
        )
    close = second.off < _CLOSE * best.off
    alike = f"; {second.material.name} fits equally well ({second.off:.3g}) and would give another level"
    return MadeOf(
        best.material,
        f"old material: {best.material.name} assumed, whose dampings differ by a median factor of {best.off:.3g} from "
        f"those of the modes{alike if close else ''}; give {option} if known",
    )


def _changed_to(edits: Sequence[object]) -> Material | None:
    """Return the material of the last change of it, None where there is none or what followed may have changed it."""
    for entry in reversed(edits):
        kind = entry.get("edit") if isinstance(entry, dict) else None
        if kind not in _KEEPING:
            return None
        if kind == "change_material":
            assert isinstance(entry, dict)
            return Material(**entry["to"])
    return None
