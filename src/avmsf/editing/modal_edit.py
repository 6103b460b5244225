"""An edit of an object's modes: common factors and one set of factors a mode, the same at all contacts."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from avmsf.editing.edits import edited
from avmsf.errors import EditError
from avmsf.field.gain_field import Gains
from avmsf.field.sound_field import SoundField
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize_phased


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
    def damping_factor(self) -> float:
        """Common factor on all dampings, without their own shifts: kappa."""
        return float(self.damping.detach().exp())

    @property
    def decay_factor(self) -> float:
        """Common factor on all decay times, as `adjust_modes`'s `decay`: 1 / kappa."""
        return 1.0 / self.damping_factor

    def to(self, device: torch.device | str) -> "ModalEdit":
        """Return the edit on a device."""
        return ModalEdit(**{each.name: getattr(self, each.name).to(device) for each in fields(self)})

    def louder(self, factor: Float[Tensor, ""]) -> "ModalEdit":
        """Return the edit with all gains multiplied by a factor above 0."""
        return replace(self, scale=self.scale + factor.double().log())

    def following(self, bank: ModalBank) -> "ModalEdit":
        """Return the edit of a bank with the gains of a mode from f1 to f2 Hz multiplied by f1 / f2 (paper, eq. 21)."""
        return replace(self, scale=self.scale + (bank.frequency / self.bank(bank).frequency).log())

    def bank(self, bank: ModalBank) -> ModalBank:
        """Return the edited modes, in the order of the given ones."""
        return ModalBank(
            torch.exp(self.pitch + bank.frequency.log() + self.shift),
            bank.damping * torch.exp(self.damping + self.damping_shift),
        )

    def of(self, field: SoundField, *, told: Mapping[str, Any] | None = None) -> SoundField:
        """Return the edited field, an ordinary one: it renders, saves, localises and can be edited again.

        `told`, plain values, joins the common factors in the last entry of `origin.report["edits"]`. Modes at half the
        sample rate or above are silent. Raises `EditError` for another number of modes, and for a frequency, damping or
        gain that is not finite.
        """
        if len(self.shift) != len(field.bank):
            raise EditError(
                f"expected an edit of the field's {len(field.bank)} modes, got one of {len(self.shift)}",
                name="shift",
                value=len(self.shift),
            )
        bank = self.bank(field.bank)
        return edited(
            field,
            ModalBank(bank.frequency.detach(), bank.damping.detach()),
            self.scale.detach().exp(),
            entry={"edit": "guided", "pitch": self.pitch_factor, "decay": self.decay_factor, **(told or {})},
        )


@dataclass(frozen=True, eq=False)
class Struck:
    """A field at some contacts, whose modes can be edited."""

    bank: ModalBank
    """The field's own modes."""
    phase: Float64[Tensor, " modes"]
    """Radians."""
    known: Gains
    """Of the field itself at the contacts."""
    sample_rate: float
    """Hz."""
    samples: int
    """Length of the sounds."""

    @classmethod
    def at(
        cls,
        field: SoundField,
        contacts: Float[Tensor, "contacts 3"],
        *,
        samples: int,
        device: torch.device | None = None,
    ) -> "Struck":
        """Evaluate a field at contacts (object frame, meters) for impacts along the inward normals."""
        known = field.known(contacts)
        place = torch.device("cpu") if device is None else device
        parts = (known.mean, known.quadrature, known.damping)
        return cls(
            ModalBank(field.bank.frequency.to(place), field.bank.damping.to(place)),
            field.phase.to(place),
            Gains(*(None if part is None else part.to(place) for part in parts)),  # type: ignore[arg-type]
            field.sample_rate,
            samples,
        )

    def first(self, count: int) -> "Struck":
        """Return the field at the first `count` of the contacts."""
        parts = (self.known.mean, self.known.quadrature, self.known.damping)
        return replace(self, known=Gains(*(None if part is None else part[:count] for part in parts)))  # type: ignore[arg-type]

    def sounds(self, edit: ModalEdit) -> Float[Tensor, "contacts samples"]:
        """Return the sounds of the edited modes, without the residual; differentiable in the edit."""
        bank = edit.bank(self.bank)
        heard = self.audible(bank)
        scale = torch.where(heard, edit.scale.exp(), 0.0).to(self.known.mean)
        quadrature = self.known.quadrature
        # A silent mode's phase must not run beyond what float64 resolves.
        frequency = torch.where(heard, bank.frequency, self.bank.frequency)
        return synthesize_phased(
            self.known.mean * scale,
            frequency,
            bank.damping if self.known.damping is None else bank.damping * self.known.damping,
            self.phase,
            samples=self.samples,
            sample_rate=self.sample_rate,
            quadrature=None if quadrature is None else quadrature * scale,
        )

    def audible(self, bank: ModalBank) -> Bool[Tensor, " modes"]:
        """Return which modes lie below half the sample rate: the others would alias, and are silent."""
        return bank.frequency.detach() < self.sample_rate / 2

    def energy(self) -> Float64[Tensor, " modes"]:
        """Return each unedited mode's energy over time (`Gains.energy`); zero for silent ones."""
        return torch.where(self.audible(self.bank), self.known.energy(self.bank.damping), 0.0)

    def loudest(self, count: int) -> Int[Tensor, " edited"]:
        """Return the indices of the strongest modes, at most `count` of them, ascending."""
        return torch.argsort(self.energy(), descending=True)[:count].sort().values
