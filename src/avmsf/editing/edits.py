"""The common part of all edits of a field: other modes, factors on the gains, and an entry in the field's report."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from avmsf._utils.wording import counted
from avmsf.errors import EditError
from avmsf.field.scaled_gains import ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.field.uncertainty import scale_of
from avmsf.modal.modes import ModalBank

EDITS = "edits"
"""Key of a field's report that lists its edits, in order."""


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
                f"mode {row} ({float(field.bank.frequency[row]):.4g} Hz): expected a finite {name}"
                f"{'' if name == 'gain factor' else ' above 0'} after the edit, got {float(values[row]):g}; edit less",
                row=row,
                name=name,
                value=float(values[row]),
            )
    changed = replace(field, bank=bank, gain_field=ScaledGains(field.gain_field, scale, length))
    silent = bank.frequency[silenced(changed)].tolist()
    listed = [*field.origin.report.get(EDITS, []), {**entry, "silent_hertz": silent}]
    report = {**field.origin.report, EDITS: listed}
    return replace(changed, origin=replace(field.origin, report=report))


def muted(field: SoundField) -> Bool[Tensor, " modes"]:
    """Return which modes edits have given gains of zero; no edit restores them."""
    return scale_of(field) == 0


def silenced(field: SoundField) -> Bool[Tensor, " modes"]:
    """Return which modes are silent because they lie at half the sample rate or above.

    They stay in the bank for edits that restore them.
    """
    return ~field.audible & ~muted(field)


def remarks(entries: Sequence[Mapping[str, Any]], field: SoundField) -> list[str]:
    """Return messages on the edits `entries` and on modes of the field that are silent."""
    words = [remark for entry in entries for remark in entry.get("remarks", [])]
    silent = field.bank.frequency[silenced(field)].tolist()
    if silent:
        words.append(
            f"{len(silent)} of {counted(len(field.bank), 'mode')}, from {min(silent):.4g} Hz to {max(silent):.4g} Hz, "
            f"{'is' if len(silent) == 1 else 'are'} silent because not below half the sample rate of "
            f"{field.sample_rate:g} Hz; lower the pitch to restore them"
        )
    if not bool((field.audible & ~muted(field)).any()):
        words.append("no mode is audible, only residual noise; edit less")
    return words
