"""The page's sliders as one value, and the edited field that they give."""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch

from avmsf.editing.material import edit, infer_material
from avmsf.editing.modal_edit import EDITS, remarks
from avmsf.errors import EditError
from avmsf.fem.material import material_named
from avmsf.field.sound_field import SoundField
from avmsf.studio.responses import bad_request

OLD_MATERIAL = "Present material"
"""What the page calls its choice of the old material."""
_NEUTRAL = {"size": 1.0, "pitch": 1.0, "decay": 1.0, "brightness": 0.0, "db": 0.0}
_LIMITS = {
    # Lengths of struck objects lie between a millimeter and tens of meters; frequencies go with 1 / size.
    "size": (1e-3, 1e3),
    # From one end of hearing, 20 Hz, to the other, 20 kHz. What is farther off is inaudible for every object.
    "pitch": (1e-3, 1e3),
    # Decay times of objects lie between 10 ms (rubber) and 10 s (bells).
    "decay": (1e-3, 1e3),
    # A mode farther below the others cannot be represented in float32 with them, whose precision spans 144 dB.
    "db": (-120.0, 120.0),
    # Decibels an octave: over the ten octaves of hearing no more than float32 holds.
    "brightness": (-40.0, 40.0),
}
"""The least and the greatest value of each slider. The page's own sliders stay far within."""
_MAX_ROW = 1 << 31
"""Rows of a field's bank: far more than any has, and few enough digits to repeat."""
MUTE = -math.inf
"""Decibels that a mode is muted by; in JSON, where there are no such numbers, null."""


@dataclass(frozen=True)
class Sliders:
    """All sliders of the page; at rest they leave the field as it was opened."""

    material: str | None = None
    """New material."""
    old: str | None = None
    """Material of the object; by default estimated from its dampings."""
    size: float = 1.0
    """The new object's lengths over the old one's."""
    pitch: float = 1.0
    """Factor on all frequencies."""
    decay: float = 1.0
    """Factor on the times in which modes die away."""
    brightness: float = 0.0
    """Decibels an octave."""
    modes: Mapping[int, Mapping[str, float]] = field(default_factory=dict)
    """By row in the bank of the field as it was opened: the change of its level, `db` or MUTE, and factors on `pitch`
    and `decay` in addition to those of all modes."""

    @classmethod
    def read(cls, request: Mapping[str, Any], *, modes: int | None = None) -> "Sliders":
        """Return the sliders of a request for a field of so many `modes`.

        Raises RequestError (400), with the name of the entry, for unknown entries, values that are no numbers or
        outside `_LIMITS`, and for more rows than modes.
        """
        sliders = ("size", "pitch", "decay", "brightness")
        _check_keys(request, ("base", "material", "modes", *sliders), "an edit")
        material = request.get("material") or {}
        _check_keys(material, ("from", "to"), "material")
        rows = request.get("modes") or []
        if not isinstance(rows, list):
            raise bad_request("modes", "a list", rows, advice="reload the page")
        if modes is not None and len(rows) > modes:
            raise bad_request("modes", f"at most {modes} rows, one per mode", len(rows))
        changes: dict[int, dict[str, float]] = {}
        for row in rows:
            _check_keys(row, ("mode", "db", "pitch", "decay"), "a mode")
            mode = row.get("mode")
            if not isinstance(mode, int) or isinstance(mode, bool) or not 0 <= mode < _MAX_ROW:
                raise bad_request("mode", "an index from 0", mode, advice="reload the page")
            if mode in changes:
                raise bad_request("modes", "one row per mode", [mode], got=f"several of mode {mode}")
            changes[mode] = {name: _number(row, name) for name in ("db", "pitch", "decay")}
        values = {name: _number(request, name) for name in sliders}
        return cls(_name(material, "to"), _name(material, "from"), modes=changes, **values)

    def to_json(self) -> dict[str, Any]:
        """Return what `read` makes these sliders of."""
        values = asdict(self)
        names = {"from": values.pop("old"), "to": values.pop("material")}
        rows = [{"mode": mode, **row} for mode, row in self.modes.items()]
        values["modes"] = [{**row, "db": None if row["db"] == MUTE else row["db"]} for row in rows]
        return {"material": names if any(names.values()) else None, **values}

    def apply(self, ground: SoundField) -> tuple[SoundField, list[str]]:
        """Return the edited field and what its owner should know. Raises EditError and SimulationError as edits do."""
        edited, notes, old = ground, list[str](), None if self.old is None else material_named(self.old)
        new = None if self.material is None else material_named(self.material)
        if old is None and (new is not None or self.size != 1.0):
            old, known = infer_material(ground, option=f'"{OLD_MATERIAL}"', new=new)
            notes.append(known)
        if replace(self, old=None) != REST:
            edited = edit(
                ground,
                material=new,
                old_material=old,
                size=self.size,
                brightness_db=self.brightness,
                **self._mode_values(len(ground.bank)),
            )
        entries = edited.origin.report.get(EDITS, [])[len(ground.origin.report.get(EDITS, [])) :]
        return edited, notes + remarks(entries, edited)

    def _mode_values(self, count: int) -> dict[str, Any]:
        """Return pitch, decay and level: one value for all modes, or where modes were set by hand one for each."""
        if not self.modes:
            return {"pitch": self.pitch, "decay": self.decay}
        levels = torch.zeros(count, dtype=torch.float64)
        pitch, decay = torch.full_like(levels, self.pitch), torch.full_like(levels, self.decay)
        for mode, row in self.modes.items():
            if mode >= count:
                raise EditError.expected(f"0 to {count - 1}", mode, name="mode", advice="reload the page")
            levels[mode] += row["db"]
            pitch[mode] *= row["pitch"]
            decay[mode] *= row["decay"]
        return {"pitch": pitch, "decay": decay, "gains_db": levels}


REST = Sliders()
"""Sliders that change nothing."""


def _check_keys(values: Any, known: tuple[str, ...], what: str) -> None:
    if not isinstance(values, Mapping):
        raise bad_request(what, f"an object with {', '.join(known)}", values, advice="reload the page")
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise bad_request(what, ", ".join(known), unknown, advice="reload the page")


def _number(values: Mapping[str, Any], name: str) -> float:
    """Return a slider's value: the neutral one where none is given; no level is MUTE. Raises RequestError (400)."""
    value = values.get(name, _NEUTRAL[name])
    if value is None:
        return MUTE if name == "db" else _NEUTRAL[name]
    number = math.nan
    if isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(OverflowError):
            number = float(value)
    if not math.isfinite(number):
        raise bad_request(name, "a number", value)
    least, greatest = _LIMITS[name]
    if not least <= number <= greatest:
        raise bad_request(name, f"{least:g} to {greatest:g}", number, got=f"{number:g}")
    return number


def _name(material: Mapping[str, Any], key: str) -> str | None:
    value = material.get(key)
    if value is not None and not (isinstance(value, str) and len(value) <= 100):
        raise bad_request(f"material.{key}", "a name", value)
    return value or None
