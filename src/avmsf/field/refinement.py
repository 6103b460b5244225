"""Gain fields that are linear in the gains they were made from, refined end to end: the posterior is the prior."""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int
from torch import Tensor, nn

from avmsf.field.gainfield import GainField, Gains
from avmsf.modal.bank import ModalBank
from avmsf.modal.phase import turned_like

_STEP = 200.0
"""Standard errors that a parameter of one stands for: so a learning rate made for networks moves gains in time."""
_STRENGTH = 0.1
"""Spectral loss that gains are worth which are off by one standard error each: about what it measures of them."""


@runtime_checkable
class LinearGains(GainField, Protocol):
    """A gain field whose mean gains are weighted sums of the gains at the contacts that it was fitted to."""

    @property
    def values(self) -> Float64[Tensor, "contacts modes 2"]:
        """Return the gains at the contacts in two parts."""
        ...

    @property
    def report(self) -> dict[str, Any]:
        """What it chose, as plain values."""
        ...

    @property
    def noise(self) -> Float64[Tensor, "contacts modes 2"]:
        """Standard error of each of the two parts of the gains at the contacts."""
        ...

    @property
    def trusted(self) -> Bool[Tensor, " contacts"]:
        """Whether each contact is taken to be where its label says; the others' gains count for nothing."""
        ...

    def smoother(self) -> Float64[Tensor, "modes 2 contacts contacts"]:
        """Return what each contact's gain counts for at each contact, for each part of each mode."""
        ...

    def leave_one_out(self) -> Float64[Tensor, "contacts modes 2"]:
        """Return the gains at each contact as predicted from the contacts at all other places.

        What the field chose with all contacts (smoothing, body, outliers) stays. There have to be two places.
        """
        ...

    def with_values(self, values: Float64[Tensor, "contacts modes 2"]) -> "LinearGains":
        """Return the field made of other gains at the same contacts."""
        ...

    def judged_by(self, measured: Float64[Tensor, "contacts modes 2"]) -> "LinearGains":
        """Return the same field, which says how sure it is by how others foretell these gains of the same contacts."""
        ...

    def take(self, modes: Int[Tensor, " modes"]) -> "LinearGains":
        """Return the field of the given modes, in the given order."""
        ...


class RefinedGains(nn.Module):
    """A linear gain field whose measured gains may move, as far as their standard errors allow."""

    smoother: Float32[Tensor, "modes 2 contacts contacts"]
    start: Float32[Tensor, "contacts modes 2"]
    noise: Float32[Tensor, "contacts modes 2"]
    free: Float32[Tensor, "contacts 1 1"]
    share: Float32[Tensor, " modes"]

    def __init__(self, field: LinearGains, bank: ModalBank, *, signs: Float[Tensor, " contacts"] | None = None) -> None:
        """Start from a field of the modes of `bank`, whose energies say how much a gain matters.

        `signs` are those by which the field's gains were taken, over the recordings'; all one without them.
        """
        super().__init__()
        self.field = field
        self.signs = torch.ones(len(field.values)) if signs is None else signs
        smoother = field.smoother()
        self.register_buffer("smoother", smoother.float())
        self.register_buffer("start", _applied(smoother, field.values).float())
        self.register_buffer("noise", field.noise.float())
        self.register_buffer("free", field.trusted[:, None, None].float())
        energy = field.values.square().sum((0, 2)) / bank.damping
        self.register_buffer("share", (energy / energy.sum().clamp_min(torch.finfo(torch.float64).tiny)).float())
        self.shift = nn.Parameter(torch.zeros_like(self.start))

    @property
    def report(self) -> dict[str, Any]:
        """What the field chose."""
        return self.field.report

    def heeded(self, contacts: int) -> list[int]:
        """Return the contacts that the field trusts."""
        return torch.nonzero(self.field.trusted).flatten().tolist()

    def read(self, rows: Int[Tensor, " contacts"]) -> Gains:
        """Return the gains at the contacts of these rows."""
        parts = (self.start + _applied(self.smoother, self.noise * self._moved))[rows]
        return Gains(parts[..., 0], parts[..., 1])

    @property
    def _moved(self) -> Float[Tensor, "contacts modes 2"]:
        """Shifts in standard errors; gains that count for nothing stay where they are."""
        return _STEP * self.free * self.shift

    def penalty(self) -> Float[Tensor, ""]:
        """Return the squared shifts over the squared standard errors, each mode by its part of the energy."""
        squares = self._moved.square().mean((0, 2))
        return 0.5 * _STRENGTH * (squares * self.share).sum()

    def finished(self, order: Int[Tensor, " modes"]) -> LinearGains:
        """Return the field of the gains as they stand, with its modes in the given order."""
        moved = self.field.values + (self.noise * self._moved).detach().double()
        return self.field.with_values(moved).take(order)

    def judged(self, order: Int[Tensor, " modes"], measured: Float64[Tensor, "contacts modes 2"]) -> LinearGains:
        """Return the finished field, judging itself by the gains that its modes, in order, have in the recordings.

        Frequencies that moved end to end have turned their modes, which says nothing of the gains.
        """
        finished = self.finished(order)
        return finished.judged_by(turned_like(measured * self.signs.double()[:, None, None], finished.values))


def _applied(smoother: Tensor, values: Tensor) -> Tensor:
    """Return the smoothed values, part by part and mode by mode; both values are [contacts, modes, 2]."""
    return (smoother @ values.permute(1, 2, 0)[..., None]).squeeze(-1).permute(2, 0, 1)
