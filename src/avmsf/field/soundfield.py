"""An object's sound at every contact: modes, a gain field, and noise."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.field.config import FitConfig
from avmsf.field.gains import AttentionGains
from avmsf.modal.bank import ModalBank
from avmsf.modal.residual import Residual, shape_noise
from avmsf.modal.synthesis import synthesise_phased

_BATCH = 32
"""Contacts rendered at once, which bounds the memory."""


@dataclass(frozen=True)
class Origin:
    """Where a field comes from."""

    capture: str = ""
    """Name of the capture."""
    trained_on: tuple[str, ...] = ()
    """Names of the recordings that it was fitted to."""
    per_newton: bool = False
    """Whether the recordings were divided by the force, so that a force in newtons scales a blow's sound."""
    config: FitConfig = field(default_factory=FitConfig)
    """Settings of the fit."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the fit chose and reached, as plain numbers and words."""


@dataclass(frozen=True, eq=False)
class SoundField:
    """Renders the sound of a blow anywhere on one object (paper, eq. 4)."""

    bank: ModalBank
    """Frequencies and dampings, shared by all contacts."""
    gain_field: AttentionGains
    """Gains at contacts, and the factors on the dampings where these vary."""
    phase: Float64[Tensor, " modes"]
    """How each mode starts, radians: mode k sounds as exp(-d t) sin(2 pi f t + phase). Zero in the paper."""
    residual: Residual
    """Noise beside the modes."""
    sample_rate: float
    """Samples per second of rendered sounds, Hz."""
    samples: int
    """Length of rendered sounds."""
    origin: Origin

    def gains(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts modes"]:
        """Return the signed amplitudes at the contacts (object frame, metres), in the unit of the training sounds."""
        with torch.no_grad():
            return self.gain_field(contacts)[0]

    def dampings(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts modes"]:
        """Return the dampings at the contacts, 1/s: the bank's where they are shared."""
        with torch.no_grad():
            factors = self.gain_field(contacts)[1]
        shared = self.bank.damping.expand(len(contacts), -1)
        return shared if factors is None else shared * factors

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, force: float = 1.0, samples: int | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the sound of a blow at each contact, times `force`.

        `force` in newtons where the recordings were divided by theirs, else relative to an average one of them. Of
        `samples` samples, or as long as the training sounds. The noise is one draw, the same at every contact and in
        every call, so that a contact's sound depends on nothing else.
        """
        length = self.samples if samples is None else samples
        with torch.no_grad():
            generator = torch.Generator().manual_seed(self.origin.config.seed)
            noise = shape_noise(self.residual.magnitude, contacts=1, samples=length, generator=generator)
            parts = [self._modes(part, length) for part in torch.split(contacts, _BATCH)]
            return force * (torch.cat(parts) + noise)

    def _modes(self, contacts: Float[Tensor, "contacts 3"], samples: int) -> Float[Tensor, "contacts samples"]:
        gains, factors = self.gain_field(contacts)
        damping = self.bank.damping if factors is None else self.bank.damping * factors
        return synthesise_phased(
            gains, self.bank.frequency, damping, self.phase, samples=samples, sample_rate=self.sample_rate
        )
