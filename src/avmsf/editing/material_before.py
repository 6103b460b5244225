"""The material of a field before an edit: that of its last material edit, or the one nearest to its dampings.

Adjusted modes do not change the material: its dampings are compared at the frequencies before the adjustments.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.editing.edits import EDITS
from avmsf.editing.material_guess import guess_materials
from avmsf.errors import EditError
from avmsf.fem.material import MATERIALS, Material
from avmsf.field.probable_body import ProbableBody
from avmsf.field.sound_field import SoundField
from avmsf.modal.modes import ModalBank

_CLOSE = 1.2
"""Ratio of the errors up to which the second-best material is as likely."""
_POINTS = 256
"""Points of the object that energies are taken over, about."""


@dataclass(frozen=True)
class MadeOf:
    """A material, and how it is known."""

    material: Material
    words: str
    """The message."""


def made_of(field: SoundField, *, option: str, new: Material | None = None) -> MadeOf:
    """Return a field's material: that of its last material edit or of its guess, or the one nearest to its dampings.

    The nearest among those that may be as stiff as the field's body, if it has one, by the modes weighted by energy.
    `option` is the option for the material, named in messages, which also say where what is assumed is `new`. Raises
    `EditError` where no material fits.
    """
    report = field.origin.report
    bank, last = _before_adjustments(field.bank, report.get(EDITS, []))
    if last is not None and last["edit"] == "change_material":
        known = Material(**last["to"])
        return MadeOf(known, f"old material: {known.name}, from the last material edit")
    if "guess" in report and last is None:
        guessed = Material(**report["material"])
        return MadeOf(guessed, f"old material: {guessed.name}, for which the field was guessed")
    body = ProbableBody.of(report)
    stiff = "" if body is None else f", and the most probable body has {body.specific_stiffness}"
    guesses = guess_materials(bank, _weight(field), materials=MATERIALS.values() if body is None else body.materials)
    best, second = guesses[0] if guesses else None, guesses[1] if len(guesses) > 1 else None
    if best is None or not best.fits:
        nearest = "" if best is None else f": the nearest, {best.material.name}, differs by a factor of {best.off:.3g}"
        raise EditError(
            f"expected {option}, got none, and no material has the dampings of the modes{nearest}{stiff}; give "
            f"{option}",
            name=option,
            value=None if best is None else best.material.name,
        )
    words = (
        f"old material: {best.material.name} assumed, whose dampings differ by a median factor of {best.off:.3g} from "
        f"those of the modes{stiff}"
    )
    if second is not None and second.off < _CLOSE * best.off:
        words += f"; {second.material.name} fits equally well ({second.off:.3g}) and would give another level"
    if best.material == new:
        words += "; it is the new material too, which changes nothing"
    return MadeOf(best.material, f"{words}; give {option} if known")


def _weight(field: SoundField) -> Float64[Tensor, " modes"]:
    """Return the modes' energies over the object; next to nothing for supporting poles."""
    points = field.gain_field.points
    energy = field.known(points[:: max(1, len(points) // _POINTS)]).energy(field.bank.damping)
    return torch.where(field.is_mode, energy.double(), 0.0).clamp_min(torch.finfo(torch.float64).tiny)


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
