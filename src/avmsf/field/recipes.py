"""What a gain field is made from, and the ways to make one."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.field.attention import AttentionGains
from avmsf.field.config import FitConfig
from avmsf.field.orientation import orientation_signs
from avmsf.field.training import TrainableGains, gain_scale
from avmsf.modal.extraction.extract import Extraction
from avmsf.scene.features import FeatureField

SHARED, PER_CONTACT = "shared", "per-contact"
"""Dampings that are the same everywhere, and those that vary with the contact."""


@dataclass(frozen=True, eq=False)
class GainCase:
    """Recordings whose gains are known, to be spread over an object."""

    train: Impacts
    features: FeatureField
    """Points of the object, and what is known of them."""
    modes: Extraction
    """The modes of `train`, row for row."""
    phase: Float64[Tensor, " modes"]
    """How each mode starts, radians."""
    gains: Float[Tensor, "contacts modes"]
    """Amplitudes in each recording of what starts with the phase alone, the network's aim."""
    config: FitConfig

    @property
    def signs(self) -> Float[Tensor, " contacts"]:
        """+1 or -1 a contact: what makes blows from both sides of a wall blows from one."""
        return orientation_signs(self.train.contacts, self.train.directions).to(self.gains)

    @property
    def parts(self) -> Float64[Tensor, "contacts modes 2"]:
        """The amplitudes along each mode's phase and a quarter of a period ahead of it."""
        return along_phase(self.modes.gains, self.modes.quadrature, self.phase)

    def take(self, rows: list[int]) -> "GainCase":
        """Return the case of some of the recordings, with the same modes and phases."""
        modes = replace(self.modes, gains=self.modes.gains[rows], quadrature=self.modes.quadrature[rows])
        return replace(self, train=self.train.take(rows), modes=modes, gains=self.gains[rows])


def along_phase(
    gains: Float[Tensor, "contacts modes"],
    quadrature: Float[Tensor, "contacts modes"],
    phase: Float64[Tensor, " modes"],
) -> Float64[Tensor, "contacts modes 2"]:
    """Return amplitudes of sines and cosines as those along each mode's phase (radians) and a quarter period ahead."""
    both = torch.complex(gains.double(), quadrature.double())
    return torch.view_as_real(both * torch.polar(torch.ones_like(phase), -phase))


@runtime_checkable
class GainRecipe(Protocol):
    """A way to make a gain field."""

    @property
    def name(self) -> str:
        """What reports, tables and the command line call it."""
        ...

    @property
    def warms_up(self) -> bool:
        """Whether gains have to be learnt before the end-to-end stage, step by step."""
        ...

    def digest(self) -> str:
        """Return what tells this recipe from others, beside the config."""
        ...

    def dampings(self, config: FitConfig) -> tuple[str, ...]:
        """Return the forms of damping to choose from."""
        ...

    def start(self, case: GainCase, damping: str) -> TrainableGains:
        """Return the field as it is before training. Raises AvmsfError where it cannot be had."""
        ...

    def rows(self, case: GainCase) -> Int[Tensor, " contacts"]:
        """Return what the field reads for the case's contacts."""
        ...


@dataclass(frozen=True, eq=False)
class Attention:
    """The paper's network, on the features of the fit or on its own."""

    features: FeatureField | None = None
    """What it reads in place of the fit's features."""
    label: str = "attention"

    @property
    def name(self) -> str:
        """As labelled."""
        return self.label

    @property
    def warms_up(self) -> bool:
        """The network learns the gains first (paper, eq. 13)."""
        return True

    def digest(self) -> str:
        """Return the name and the digest of the network's own features."""
        return f"attention {'' if self.features is None else self.features.digest()}"

    def dampings(self, config: FitConfig) -> tuple[str, ...]:
        """Return the config's damping, or both where it leaves that to validation."""
        return (SHARED, PER_CONTACT) if config.damping == "validated" else (config.damping,)

    def start(self, case: GainCase, damping: str) -> AttentionGains:
        """Return an untrained network."""
        gains = case.gains * case.signs[:, None]
        return AttentionGains(
            self._features(case),
            gain_scale=gain_scale(gains),
            shape=replace(case.config.shape, spatial_damping=damping == PER_CONTACT),
            generator=torch.Generator().manual_seed(case.config.seed),
        )

    def rows(self, case: GainCase) -> Int[Tensor, " contacts"]:
        """Return the points nearest to the contacts."""
        return self._features(case).nearest(case.train.contacts)

    def _features(self, case: GainCase) -> FeatureField:
        return case.features if self.features is None else self.features
