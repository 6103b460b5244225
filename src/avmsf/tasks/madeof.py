"""The material of a field before an edit: that of its last material edit, or the one nearest to its dampings.

Adjusted modes do not change the material: its dampings are compared at the frequencies before the adjustments.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from avmsf.errors import EditError
from avmsf.field.soundfield import SoundField
from avmsf.modal.bank import ModalBank
from avmsf.simulate.material import Material
from avmsf.tasks.edits import EDITS
from avmsf.tasks.materialguess import guess_materials

_CLOSE = 1.2
"""Ratio of the errors up to which the second-best material is as likely."""


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
    report = field.origin.report
    bank, last = _before_adjustments(field.bank, report.get(EDITS, []))
    if last is not None and last["edit"] == "change_material":
        known = Material(**last["to"])
        return MadeOf(known, f"old material: {known.name}, from the last material edit")
    if "guess" in report and last is None:
        guessed = Material(**report["material"])
        return MadeOf(guessed, f"old material: {guessed.name}, for which the field was guessed")
    best, second, *_ = guess_materials(bank)
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


def _before_adjustments(
    bank: ModalBank, edits: Sequence[Mapping[str, Any]]
) -> tuple[ModalBank, Mapping[str, Any] | None]:
    """Return the modes before the last adjustments of pitch and decay, and the edit before these, if there is one."""
    for entry in reversed(edits):
        if entry["edit"] != "adjust_modes":
            return bank, entry
        pitch, decay = (torch.tensor(entry[name], dtype=torch.float64) for name in ("pitch", "decay"))
        bank = ModalBank(bank.frequency / pitch, bank.damping * decay)
    return bank, None
