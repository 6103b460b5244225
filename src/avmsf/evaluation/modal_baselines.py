"""Baselines that share their modes with every contact, and differ in the gains that they give a contact."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.field.recipes import orientation_signs
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import shape_noise
from avmsf.modal.synthesis import synthesize


@dataclass(frozen=True, eq=False)
class ModalBaseline(ABC):
    """Modes of the training impacts, with gains that are made of the training contacts' own."""

    train: Impacts
    extraction: Extraction
    """Modes of the training impacts, and their gains in each of them, row for row."""
    noise: bool = field(default=False, kw_only=True)
    """Whether the extraction's residual is heard beside the modes, as it is in a field: one draw for all contacts."""
    seed: int = field(default=0, kw_only=True)
    """Start of the noise's chance."""

    def __post_init__(self) -> None:
        if len(self.extraction.gains) != len(self.train):
            raise EvaluationError(
                f"expected gains of {len(self.train)} training impacts, got those of {len(self.extraction.gains)}; "
                "extract the modes from these impacts",
                name="extraction",
                value=len(self.extraction.gains),
            )

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.train.sample_rate

    @property
    def bank(self) -> ModalBank:
        """The modes, the same at all contacts."""
        return self.extraction.bank

    @cached_property
    def amplitudes(self) -> Float[Tensor, "contacts two_modes"]:
        """The training contacts' gains in phase, then in quadrature, as if all blows came from the same side.

        Of two blows from opposite sides of a thin wall the gains are opposite too, and their mean would be silence.
        """
        both = torch.cat([self.extraction.gains, self.extraction.quadrature], dim=1)
        return both * orientation_signs(self.train.contacts, self.train.directions).to(both)[:, None]

    @abstractmethod
    def amplitudes_at(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts two_modes"]:
        """Return the gains in phase, then in quadrature, that the contacts are given."""

    def complex_gains(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Complex[Tensor, "contacts modes"]:
        """Return amplitudes A at the contacts: their sounds are the real part of the sum of A exp((-d + 2 pi i f) t).

        `directions` make no difference.
        """
        gains, quadrature = self.amplitudes_at(contacts).chunk(2, dim=1)
        return torch.complex(quadrature, -gains)

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the modes' sound at each contact, and the noise beside it where there is any."""
        gains, quadrature = self.amplitudes_at(contacts).chunk(2, dim=1)
        samples = self.train.sounds.shape[1]
        sounds = synthesize(
            gains,
            self.bank.frequency,
            self.bank.damping,
            samples=samples,
            sample_rate=self.train.sample_rate,
            quadrature=quadrature,
        )
        if not self.noise:
            return sounds
        generator = torch.Generator().manual_seed(self.seed)
        magnitude = self.extraction.residual.magnitude
        return sounds + shape_noise(magnitude, contacts=1, samples=samples, generator=generator)
