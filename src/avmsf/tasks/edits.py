"""What all edits of a field have in common: other modes, factors on the gains, and a word in the field's report."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from avmsf.errors import EditError
from avmsf.field.scaledgains import ScaledGains
from avmsf.field.soundfield import SoundField
from avmsf.field.uncertainty import scale_of
from avmsf.modal.bank import ModalBank

EDITS = "edits"
"""Where a field's report lists what was done to it, in this order."""


def edited(
    field: SoundField,
    bank: ModalBank,
    scale: Float64[Tensor, " modes"],
    *,
    entry: Mapping[str, Any],
    length: float = 1.0,
) -> SoundField:
    """Return the field of other modes, its gains times `scale`, its lengths times `length`.

    The modes stay in the order that they had, whatever their frequencies have become, so that mode k is the same before
    and after. `entry`, plain values, ends the list of edits, with the frequencies of the modes that are `silenced`.
    Raises `EditError` where a frequency or a damping is not positive, or a number too large.
    """
    for name, values in (("frequency", bank.frequency), ("damping", bank.damping), ("gain factor", scale)):
        fine = torch.isfinite(values) & (values > 0 if name != "gain factor" else True)
        if not bool(fine.all()):
            row = int(torch.nonzero(~fine)[0])
            raise EditError(
                f"the edit gives mode {row} (counted from 0, {float(field.bank.frequency[row]):.4g} Hz) the {name} "
                f"{float(values[row]):g}: expected a finite one{'' if name == 'gain factor' else ' above 0'}; edit less"
            )
    changed = replace(field, bank=bank, gain_field=ScaledGains(field.gain_field, scale, length))
    silent = bank.frequency[silenced(changed)].tolist()
    listed = [*field.origin.report.get(EDITS, []), {**entry, "silent_hertz": silent}]
    report = {**field.origin.report, EDITS: listed}
    return replace(changed, origin=replace(field.origin, report=report))


def muted(field: SoundField) -> Bool[Tensor, " modes"]:
    """Return which modes edits have taken all gains of: nothing brings these back."""
    return scale_of(field) == 0


def silenced(field: SoundField) -> Bool[Tensor, " modes"]:
    """Return which modes are silent because they lie at half the sample rate or above.

    They stay in the bank for edits that bring them back.
    """
    return ~field.audible & ~muted(field)


def remarks(entries: Sequence[Mapping[str, Any]], field: SoundField) -> list[str]:
    """Return what the owner of an edited field should know of the edits `entries` and of it as it is, in sentences."""
    words = [remark for entry in entries for remark in entry.get("remarks", [])]
    silent = field.bank.frequency[silenced(field)].tolist()
    if silent:
        words.append(
            f"{len(silent)} of {len(field.bank)} modes lie at or above half the sample rate of "
            f"{field.sample_rate:g} Hz and are silent, from {min(silent):.4g} Hz to {max(silent):.4g} Hz; an edit that "
            "lowers them brings them back"
        )
    if not bool((field.audible & ~muted(field)).any()):
        words.append("nothing but noise is left of the sound: edit less")
    return words
