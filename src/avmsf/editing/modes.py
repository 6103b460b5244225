"""Manual edits of a field: frequencies, decay times, brightness, and level of each mode."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from avmsf.editing.edits import edited
from avmsf.errors import EditError
from avmsf.field.scaled_gains import fitted_gains
from avmsf.field.sound_field import SoundField
from avmsf.modal.modes import ModalBank

Slider = float | Sequence[float] | Float[Tensor, " modes"]
"""One value for all modes, or one for each."""
_POINTS = 256
"""Points of the object that a mode's strength is taken over, at most."""


def adjust_modes(
    field: SoundField,
    *,
    pitch: Slider = 1.0,
    decay: Slider = 1.0,
    brightness_db: float = 0.0,
    gains_db: Slider = 0.0,
) -> SoundField:
    """Return the field with other frequencies, decay times and levels of its modes.

    `pitch` multiplies frequencies, `decay` the modes' decay times, and `gains_db` raises modes by so many decibels,
    -inf mutes one; each is one number for all modes or one a mode, in the bank's order. `brightness_db` tilts the
    spectrum by so many decibels an octave about `brightness_center`, at the edited frequencies. Ratios of gains between
    contacts stay.

    Without values nothing changes. Two edits after one another are the one with both factors and the sums of decibels,
    unless modes of a brightened field move by factors of their own. What was done is the last entry of
    `origin.report["edits"]`, with the modes that have moved to half the sample rate or above: they are silent, and come
    back with an edit that lowers them. Raises `EditError` for factors that are not positive, levels that are no
    numbers, another number of values than there are modes, and what makes a mode no number.
    """
    factors = {name: _values(field, value, name) for name, value in (("pitch", pitch), ("decay", decay))}
    for name, values in factors.items():
        _expect(torch.isfinite(values) & (values > 0), name, values, "factors above 0, such as 0.5 for half the value")
    levels = _values(field, gains_db, "gains_db")
    _expect(levels < math.inf, "gains_db", levels, "decibels, or -inf for silence")
    if not math.isfinite(brightness_db):
        raise EditError.expected("decibels an octave, such as 3", brightness_db, name="brightness_db")
    bank = ModalBank(field.bank.frequency * factors["pitch"], field.bank.damping / factors["decay"])
    if brightness_db:
        center = brightness_center(field, bank)
        levels = levels + brightness_db * torch.log2(bank.frequency / center)
    entry: dict[str, Any] = {
        "edit": "adjust_modes",
        "pitch": _told(factors["pitch"]),
        "decay": _told(factors["decay"]),
        "brightness_db": float(brightness_db),
        "gains_db": _told(_values(field, gains_db, "gains_db")),
    }
    return edited(field, bank, 10.0 ** (levels / 20.0), entry=entry)


def brightness_center(field: SoundField, bank: ModalBank | None = None) -> float:
    """Return the frequency, Hz, that brightness leaves as loud as it is: where a field's energy has its center.

    The geometric mean of the frequencies, those of `bank` where one is given, each counted by the mean square of its
    gains over the object as these were before any edit; so that edits do not move it, but as pitch does.
    """
    gains = fitted_gains(field.gain_field)
    points = gains.points[:: max(1, math.ceil(len(gains.points) / _POINTS))]
    with torch.no_grad():
        known = gains.point_estimate(points)
    power = known.power.mean(0)
    share = power / power.sum() if bool(power.any()) else torch.full_like(power, 1.0 / len(power))
    frequency = (field.bank if bank is None else bank).frequency
    return math.exp(float((share * frequency.log()).sum()))


def _values(field: SoundField, value: Slider, name: str) -> Float64[Tensor, " modes"]:
    """Return one value a mode."""
    values = torch.as_tensor(value, dtype=torch.float64)
    modes = len(field.bank)
    if values.ndim > 1 or (values.ndim == 1 and len(values) != modes):
        raise EditError(
            f"{name}: expected one value, or one for each of {modes} modes, got the shape {list(values.shape)}",
            name=name,
            value=list(values.shape),
        )
    return values.expand(modes)


def _expect(fine: Bool[Tensor, " modes"], name: str, values: Float64[Tensor, " modes"], wanted: str) -> None:
    if not bool(fine.all()):
        row = int(torch.nonzero(~fine)[0])
        value = float(values[row])
        where = name if bool((values == value).all()) else f"{name}, mode {row}"
        raise EditError(f"{where}: expected {wanted}, got {value:g}", row=row, name=name, value=value)


def _told(values: Float64[Tensor, " modes"]) -> float | list[float | None] | None:
    """Return values as JSON can hold them: one where all are alike, None for what is muted."""
    plain = [each if math.isfinite(each) else None for each in values.tolist()]
    return plain[0] if len(set(plain)) == 1 else plain
