"""An object's sound at every contact: modes, a gain field, and noise."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Complex, Float, Float64
from torch import Tensor

from avmsf.capture.settings import CaptureSettings
from avmsf.field.config import FitConfig
from avmsf.field.gainfield import GainField, Gains
from avmsf.field.gains.model import MixtureGains
from avmsf.field.scaledgains import ScaledGains, fitted_gains
from avmsf.modal.bank import ModalBank
from avmsf.modal.pulse import ForcePulse
from avmsf.modal.residual import Residual, low_fluctuation_noise, shape_noise
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
    """Whether the recordings were divided by the force, so that a force in newtons scales an impact's sound."""
    config: FitConfig = field(default_factory=FitConfig)
    """Settings of the fit."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the fit chose and reached, as plain numbers and words."""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    """By which its recordings were read."""


@dataclass(frozen=True)
class FieldQuality:
    """Relative STFT errors at training contacts, each predicted from those at all other places."""

    places: int
    """Places that were left out in turn, each with all of its recordings."""
    error: float
    """Of the field; modes, and the prior of its gain model's hypotheses, are those of all contacts."""
    averaging: float
    """Of the mean of the three nearest recordings at other places."""
    next_contact: tuple[float, float, float] | None = None
    """The contact (object frame, meters) that reduces the field's expected error most; None if there is no other."""
    next_distance: float | None = None
    """From there to the nearest contact that was recorded, meters."""

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> "FieldQuality":
        """Return it from plain values, as they are in a file."""
        contact = record.get("next_contact")
        return cls(**{**record, "next_contact": None if contact is None else tuple(contact)})

    def __str__(self) -> str:
        """Return the verdict, and the advice if there is any."""
        return " ".join(filter(None, [self.verdict, self.advice]))

    @property
    def verdict(self) -> str:
        """How good the field is. Leaving out mostly overstates the error: spread contacts are far from each other."""
        if self.error < self.averaging:
            return (
                f"At contacts left out the relative STFT error of the field is about {self.error:.2f}, of "
                f"averaging the three nearest recordings {self.averaging:.2f} ({self.places} places)."
            )
        return (
            f"No better than averaging the three nearest recordings: relative STFT errors of {self.error:.2f} and "
            f"{self.averaging:.2f} at contacts left out ({self.places} places). Give a mesh, or record more places."
        )

    @property
    def advice(self) -> str:
        """Where another impact would help most; empty if that is not known."""
        if self.next_contact is None or self.next_distance is None:
            return ""
        where = ", ".join(f"{value + 0.0:.3f}" for value in self.next_contact)
        return (
            f"Another impact near ({where}) m, {1000 * self.next_distance:.0f} mm from the nearest contact, would help "
            "most."
        )


@dataclass(frozen=True, eq=False)
class SoundField:
    """Renders the sound of an impact anywhere on one object (paper, eq. 4)."""

    bank: ModalBank
    """Frequencies and dampings, shared by all contacts."""
    gain_field: GainField
    """Gains at contacts, and the factors on the dampings where these vary."""
    phase: Float64[Tensor, " modes"]
    """How each mode starts, radians: mode k sounds as exp(-d t) sin(2 pi f t + phase). Zero in the paper."""
    residual: Residual
    """Noise in addition to the modes."""
    sample_rate: float
    """Samples per second of rendered sounds, Hz."""
    samples: int
    """Length of rendered sounds."""
    origin: Origin

    @property
    def quality(self) -> FieldQuality | None:
        """How well its contacts are predicted from one another.

        None for few places, for the attention network, and for an edited field, which nobody recorded.
        """
        found = None if self.origin.report.get("edits") else self.origin.report.get("quality")
        return FieldQuality.of(found) if isinstance(found, dict) else None

    @property
    def audible(self) -> Bool[Tensor, " modes"]:
        """Which modes sound: those below half the sample rate, above which an edit may have moved some."""
        return self.bank.frequency < 0.5 * self.sample_rate

    def gains(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts modes"]:
        """Return the signed amplitudes at the contacts (object frame, metres), in the unit of the training sounds.

        `directions`, unit vectors, are those of the impacts; without them they go straight into the surface.
        """
        return self.known(contacts, directions=directions).mean

    def complex_gains(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Complex[Tensor, "contacts modes"]:
        """Return amplitudes A at the contacts: their sounds are the real part of the sum of A exp((-d + 2 pi i f) t).

        Contacts, directions and unit as in `gains`; dampings d are those of the contacts.
        """
        sines, cosines = self.known(contacts, directions=directions).parts.unbind(2)
        return torch.complex(cosines, -sines) * torch.exp(1j * self.phase)

    def known(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Gains:
        """Return all that a sound needs at the contacts: both parts of the gains, and the factors on the dampings."""
        with torch.no_grad():
            return self.gain_field.at(contacts, directions)

    def dampings(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts modes"]:
        """Return the dampings at the contacts, 1/s: the bank's where they are shared."""
        factors = self.known(contacts).damping
        shared = self.bank.damping.expand(len(contacts), -1)
        return shared if factors is None else shared * factors

    def render(
        self,
        contacts: Float[Tensor, "contacts 3"],
        *,
        directions: Float[Tensor, "contacts 3"] | None = None,
        force: float = 1.0,
        samples: int | None = None,
        pulse: ForcePulse | None = None,
    ) -> Float[Tensor, "contacts samples"]:
        """Return the sound of an impact at each contact, along `directions` as in `gains`, times `force`.

        `force` in newtons where the recordings were divided by theirs, else relative to an average one of them. Of
        `samples` samples, or as long as the training sounds. The noise is the same at every contact and in every call,
        so that a contact's sound depends on nothing else. Modes that are not `audible` are silent.

        `pulse` is what a softer hammer adds to the recorded impacts' own pulses; it has the same impulse, however long
        it is, and leaves the noise as it is. The noise grows with `force` as the modes do, which is a simplification:
        recorded background noise does not depend on the force of an impact.
        """
        length = self.samples if samples is None else samples
        noise = None if self.residual.recordings is not None else self.noise(samples)
        parts = []
        for rows in torch.split(torch.arange(len(contacts)), _BATCH):
            known = self.known(contacts[rows], directions=None if directions is None else directions[rows])
            modes = self.modal_sounds(known, length)
            sounds = modes if pulse is None else pulse.soften(modes, sample_rate=self.sample_rate)
            way = None if directions is None else directions[rows]
            parts.append(sounds + (self._recorded(contacts[rows], way, length) if noise is None else noise))
        return force * torch.cat(parts)

    def _recorded(
        self,
        contacts: Float[Tensor, "contacts 3"],
        directions: Float[Tensor, "contacts 3"] | None,
        samples: int,
    ) -> Float[Tensor, "contacts samples"]:
        """Return the mean of what the nearest recordings have in addition to their modes; silence after their end."""
        gains, recordings = fitted_gains(self.gain_field), self.residual.recordings
        assert isinstance(gains, MixtureGains)
        assert recordings is not None
        length = self.gain_field.length if isinstance(self.gain_field, ScaledGains) else 1.0
        rows, signs = gains.nearest(gains.sites(contacts.double() / length, directions))
        found = (recordings[rows] * signs[..., None]).mean(1).float()[:, :samples]
        return torch.nn.functional.pad(found, (0, samples - found.shape[1]))

    def noise(self, samples: int | None = None) -> Float[Tensor, " samples"]:
        """Return the residual noise of an impact of force 1; `samples` as in `render`.

        Of the kind that the fit's configuration names: a fixed sequence of low fluctuation, or a Gaussian draw
        (paper, eq. 6), which differs with `samples`.
        """
        length = self.samples if samples is None else samples
        if self.origin.config.residual_noise == "low-fluctuation":
            return low_fluctuation_noise(self.residual.magnitude, samples=length)
        generator = torch.Generator().manual_seed(self.origin.config.seed)
        return shape_noise(self.residual.magnitude, contacts=1, samples=length, generator=generator)[0]

    def modal_sounds(self, known: Gains, samples: int) -> Float[Tensor, "contacts samples"]:
        """Return the sounds of the audible modes with these gains, without noise."""
        damping = self.bank.damping if known.damping is None else self.bank.damping * known.damping
        rows = torch.nonzero(self.audible).flatten()
        return synthesise_phased(
            known.mean[:, rows],
            self.bank.frequency[rows],
            damping[..., rows],
            self.phase[rows],
            samples=samples,
            sample_rate=self.sample_rate,
            quadrature=None if known.quadrature is None else known.quadrature[:, rows],
        )
