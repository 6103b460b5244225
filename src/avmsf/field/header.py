"""The record in the header of a field's file: its format, and what it may say. Importing this loads no torch."""

import math
from typing import Any

from avmsf._utils.headers import FileKind
from avmsf._utils.text import RecordError, like, record_of
from avmsf.errors import FieldFileError
from avmsf.fem.material import Material

FORMAT = 8
"""Number of this format; it grows with every change that older versions could not read. Later versions read it."""
SUPPORTING = "supporting_poles"
"""What a report calls the rows of the bank's poles that are no modes of the object."""
_RENAMED_EDITS = {"recast": "change_material", "retune": "adjust_modes", "steer": "guided"}
"""Kinds of edits that earlier versions wrote, and what they are called now."""


def checked_report(report: dict[str, Any], modes: int) -> dict[str, Any]:
    """Return the report on a field of so many modes, with its edits called as this version calls them.

    Raises RecordError for what is no edit, and for supporting poles that are no rows of the bank.
    """
    for row, pole in enumerate(like(report.get(SUPPORTING, []), [], f"origin.report.{SUPPORTING}")):
        name = f"origin.report.{SUPPORTING}.{row}"
        if not 0 <= like(pole, 0, name) < modes:
            raise RecordError.expected(f"a row from 0 to {modes - 1}", pole, name=name)
    edits = like(report.get("edits", []), [], "origin.report.edits")
    found = [_edit_of(entry, f"origin.report.edits.{row}", modes) for row, entry in enumerate(edits)]
    return {**report, "edits": found} if found else report


def _edit_of(entry: Any, name: str, modes: int) -> dict[str, Any]:
    known: dict[str, Any] = like(entry, {}, name)
    written = like(known.get("edit"), "", f"{name}.edit")
    kind = _RENAMED_EDITS.get(written, written)
    if kind == "change_material":
        record_of(Material, known.get("to"), f"{name}.to")
    if kind == "adjust_modes":
        for key in ("pitch", "decay"):
            factors = known.get(key)
            for factor in factors if isinstance(factors, list) and len(factors) == modes else [factors]:
                if not 0.0 < like(factor, 1.0, f"{name}.{key}") < math.inf:
                    raise RecordError.expected("a number above 0", factor, name=f"{name}.{key}")
    return {**known, "edit": kind}


FIELD = FileKind("avmsf", "a sound field", "fit and save it again", FieldFileError, (FORMAT,))
