"""An edit of an object's modes: common factors and one set of factors a mode, the same at all contacts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from avmsf._utils.text import counted
from avmsf.errors import EditError
from avmsf.field.gains.model import Gains
from avmsf.field.gains.scaled import ScaledGains
from avmsf.field.sound_field import SoundField
from avmsf.modal.modes import ModalBank
from avmsf.modal.spectra import Sounds

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
            above = "" if name == "gain factor" else " above 0"
            wanted = f"a finite value{above} after the edit of the mode at {float(field.bank.frequency[row]):.4g} Hz"
            raise EditError.expected(wanted, float(values[row]), row=row, name=name, advice="edit less")
    changed = replace(field, bank=bank, gain_field=ScaledGains(field.gain_field, scale, length))
    silent = bank.frequency[silenced(changed)].tolist()
    listed = [*field.origin.report.get(EDITS, []), {**entry, "silent_hertz": silent}]
    report = {**field.origin.report, EDITS: listed}
    return replace(changed, origin=replace(field.origin, report=report))


def muted(field: SoundField) -> Bool[Tensor, " modes"]:
    """Return which modes edits have given gains of zero; no edit restores them."""
    return field.scale == 0


def silenced(field: SoundField) -> Bool[Tensor, " modes"]:
    """Return which modes of the object are silent because they lie at half the sample rate or above.

    They stay in the bank for edits that restore them.
    """
    return ~field.audible & ~muted(field) & field.is_mode


def remarks(entries: Sequence[Mapping[str, Any]], field: SoundField) -> list[str]:
    """Return messages on the edits `entries` and on modes of the field that are silent."""
    words = [remark for entry in entries for remark in entry.get("remarks", [])]
    silent, modes = field.bank.frequency[silenced(field)].tolist(), counted(int(field.is_mode.sum()), "mode")
    if silent:
        words.append(
            f"{len(silent)} of {modes}, from {min(silent):.4g} Hz to {max(silent):.4g} Hz, "
            f"{'is' if len(silent) == 1 else 'are'} silent because not below half the sample rate of "
            f"{field.sample_rate:g} Hz; lower the pitch to restore them"
        )
    if not bool((field.audible & ~muted(field)).any()):
        words.append("no mode is audible, only residual noise; edit less")
    return words


_MAX_FREQUENCY_ERROR = 0.02
"""By which part a mode's frequency may be off the one that it is called by."""


def mode_at(bank: ModalBank, frequency: float, *, option: str) -> int:
    """Return the index of the mode at a frequency, Hz. Raises EditError, named `option`, where there is none."""
    row = int((bank.frequency - frequency).abs().argmin())
    nearest = float(bank.frequency[row])
    if not abs(nearest - frequency) <= _MAX_FREQUENCY_ERROR * nearest:
        advice = f"the nearest is at {nearest:.5g} Hz (`avmsf info` lists them)"
        got = f"{frequency:g} Hz"
        raise EditError.expected("the frequency of a mode", frequency, got=got, name=option, advice=advice)
    return row


Slider = float | Sequence[float] | Float[Tensor, " modes"]
"""One value for all modes, or one for each."""
_POINTS = 256
"""Points of the object that a mode's strength is taken over, at most."""


def adjust_modes(
    field: SoundField, *, pitch: Slider = 1.0, decay: Slider = 1.0, brightness_db: float = 0.0, gains_db: Slider = 0.0
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
        _check(torch.isfinite(values) & (values > 0), name, values, "factors above 0, such as 0.5 for half the value")
    levels = _values(field, gains_db, "gains_db")
    _check(levels < math.inf, "gains_db", levels, "decibels, or -inf for silence")
    if not math.isfinite(brightness_db):
        raise EditError.expected("decibels an octave, such as 3", brightness_db, name="brightness_db")
    bank = ModalBank(field.bank.frequency * factors["pitch"], field.bank.damping / factors["decay"])
    if brightness_db:
        center = brightness_center(field, bank)
        levels = levels + brightness_db * torch.log2(bank.frequency / center)
    entry: dict[str, Any] = {
        "edit": "adjust_modes",
        "pitch": _to_json(factors["pitch"]),
        "decay": _to_json(factors["decay"]),
        "brightness_db": float(brightness_db),
        "gains_db": _to_json(_values(field, gains_db, "gains_db")),
    }
    return edited(field, bank, 10.0 ** (levels / 20.0), entry=entry)


def brightness_center(field: SoundField, bank: ModalBank | None = None) -> float:
    """Return the frequency, Hz, that brightness leaves as loud as it is: where a field's energy has its center.

    The geometric mean of the frequencies, those of `bank` where one is given, each counted by the mean square of its
    gains over the object as these were before any edit; so that edits do not move it, but as pitch does.
    """
    gains = field.gain_field.fitted
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
        wanted = f"one value, or one for each of {modes} modes, in shape"
        raise EditError.expected(wanted, list(values.shape), name=name)
    return values.expand(modes)


def _check(fine: Bool[Tensor, " modes"], name: str, values: Float64[Tensor, " modes"], wanted: str) -> None:
    if not bool(fine.all()):
        row = int(torch.nonzero(~fine)[0])
        value = float(values[row])
        where = name if bool((values == value).all()) else f"{name}, mode {row}"
        raise EditError(f"{where}: expected {wanted}, got {value:g}", row=row, name=name, value=value)


def _to_json(values: Float64[Tensor, " modes"]) -> float | list[float | None] | None:
    """Return values as JSON can hold them: one where all are alike, None for what is muted."""
    plain = [each if math.isfinite(each) else None for each in values.tolist()]
    return plain[0] if len(set(plain)) == 1 else plain


@dataclass(frozen=True, eq=False)
class ModalEdit:
    """An edit of every mode, on a logarithmic scale, zero for no change (paper, section 3.6: object sound editing).

    f_i = exp(log alpha + log f_i,init + delta_i), d_i = d_i,init exp(log kappa + epsilon_i), and one factor gamma_i on
    the gains of mode i at all contacts, so that their ratios between contacts, the spatial field, stay as they are.
    Differentiable in all five.
    """

    pitch: Float64[Tensor, ""]
    """log alpha, of all frequencies."""
    shift: Float64[Tensor, " modes"]
    """delta, of each mode's frequency in addition."""
    damping: Float64[Tensor, ""]
    """log kappa, of all dampings."""
    damping_shift: Float64[Tensor, " modes"]
    """epsilon, of each mode's damping in addition."""
    scale: Float64[Tensor, " modes"]
    """log gamma, of each mode's gains."""

    @classmethod
    def none(cls, bank: ModalBank, *, pitch: float = 0.0, damping: float = 0.0) -> "ModalEdit":
        """Return an edit of a bank by common factors only, given by their logarithms."""
        zero = torch.zeros_like(bank.frequency)
        return cls(zero.new_tensor(pitch), zero, zero.new_tensor(damping), zero, zero)

    @property
    def pitch_factor(self) -> float:
        """Common factor on all frequencies, without their own shifts: alpha."""
        return float(self.pitch.detach().exp())

    @property
    def decay_factor(self) -> float:
        """Common factor on all decay times, without their own shifts: 1 / kappa, as `decay` of `adjust_modes`."""
        return 1.0 / float(self.damping.detach().exp())

    def following(self, bank: ModalBank) -> "ModalEdit":
        """Return the edit of a bank with the gains of a mode from f1 to f2 Hz multiplied by f1 / f2 (paper, eq. 21)."""
        return replace(self, scale=self.scale + (bank.frequency / self.bank(bank).frequency).log())

    def bank(self, bank: ModalBank) -> ModalBank:
        """Return the edited modes, in the order of the given ones."""
        return ModalBank(
            torch.exp(self.pitch + bank.frequency.log() + self.shift),
            bank.damping * torch.exp(self.damping + self.damping_shift),
        )

    def of(self, field: SoundField, *, settings: Mapping[str, Any] | None = None) -> SoundField:
        """Return the edited field, an ordinary one: it renders, saves, localises and can be edited again.

        `settings`, plain values, joins the common factors in the last entry of `origin.report["edits"]`. Modes at half
        the sample rate or above are silent. Raises `EditError` for another number of modes, and for a frequency,
        damping or gain that is not finite.
        """
        if len(self.shift) != len(field.bank):
            raise EditError.expected(f"one value for each of {len(field.bank)} modes", len(self.shift), name="shift")
        bank = self.bank(field.bank)
        return edited(
            field,
            ModalBank(bank.frequency.detach(), bank.damping.detach()),
            self.scale.detach().exp(),
            entry={"edit": "guided", "pitch": self.pitch_factor, "decay": self.decay_factor, **(settings or {})},
        )


@dataclass(frozen=True, eq=False)
class FieldAtContacts:
    """A field at some contacts, whose modes can be edited."""

    field: SoundField
    known: Gains
    """Of the field itself at the contacts, for impacts along the inward normals: `SoundField.known`."""
    samples: int
    """Length of the sounds."""

    def first(self, count: int) -> "FieldAtContacts":
        """Return the field at the first `count` of the contacts."""
        parts = {name: part[:count] for name, part in vars(self.known).items() if part is not None}
        return replace(self, known=Gains(**parts))

    def sounds(self, edit: ModalEdit | None = None) -> Sounds:
        """Return the sounds of the modes, edited if an edit is given, without the residual; differentiable in it."""
        if edit is None:
            return self.field.modal_sounds(self.known, self.samples)
        scaled = replace(self.known, mean=self.known.mean * edit.scale.exp().to(self.known.mean))
        return replace(self.field, bank=edit.bank(self.field.bank)).modal_sounds(scaled, self.samples)

    def loudest(self, count: int) -> Int[Tensor, " edited"]:
        """Return the indices of the modes of most energy over time, at most `count` of them, ascending."""
        energy = torch.where(self.field.audible, self.known.energy(self.field.bank.damping), 0.0)
        return torch.argsort(energy, descending=True)[:count].sort().values
