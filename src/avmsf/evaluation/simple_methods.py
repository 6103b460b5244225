"""Baselines of a field, and what its modes alone reach.

Each baseline is a `Renderer` made only from the training impacts; nearest is by Euclidean distance, and of equally near
contacts the first. What modes alone reach is computed from the test sounds, with the best gains and without noise. A
field with noise can have less error in a spectrum.
"""

import zlib
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.evaluation.modal_baselines import ModalBaseline
from avmsf.field.gains.family import Sites, nearest_sites
from avmsf.gaussians.points import nearest_points
from avmsf.modal.extraction.least_squares import fit_gains, fit_sine_gains
from avmsf.modal.modes import ModalBank
from avmsf.modal.synthesis import synthesize


@dataclass(frozen=True, eq=False)
class WhiteNoise:
    """Gaussian white noise at the mean level of the training sounds, different for each contact.

    The level is the root mean square over the sound. (The paper says the same of its white noise, but its values are
    those of noise of peak one: see `avmsf.evaluation.metrics`.)
    """

    train: Impacts
    seed: int = 0

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.train.sample_rate

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return noise that depends only on the seed and the contact."""
        loudness = self.train.sounds.square().mean(dim=1).sqrt().mean()
        sounds = [self._noise(contact) for contact in contacts]
        return torch.stack(sounds) * loudness if sounds else self.train.sounds[:0]

    def _noise(self, contact: Float[Tensor, "3"]) -> Float[Tensor, " samples"]:
        # Adding zero makes one of the two zeros, whose bytes differ.
        place = (contact.detach().double().cpu() + 0.0).numpy().tobytes()
        # One hash of both, since torch's generator uses only the lower 32 bits of its seed.
        generator = torch.Generator().manual_seed(zlib.crc32(place, self.seed))
        noise = torch.randn(self.train.sounds.shape[1], generator=generator, dtype=self.train.sounds.dtype)
        return noise.to(self.train.sounds.device)


@dataclass(frozen=True, eq=False)
class NearestRecording:
    """The training sound whose contact is nearest."""

    train: Impacts

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.train.sample_rate

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the nearest training contact's sound."""
        return self.train.sounds[nearest_points(self.train.contacts, contacts)[:, 0]]


@dataclass(frozen=True, eq=False)
class MeanWaveform:
    """The mean of the nearest training sounds, sample by sample: the paper's KNN. Phases cancel in it.

    With `by_direction`, where the directions of both sides are known, an impact's direction is part of where it is, by
    `nearest_sites`. The size there is the diagonal of the box around the training contacts, as the object itself is not
    known here. Recordings are neighbors, each one, also those of one contact.
    """

    train: Impacts
    count: int = 3
    """How many sounds are averaged."""
    by_direction: bool = False
    """Whether directions count as well as contacts."""

    def __post_init__(self) -> None:
        _expect_neighbors(self.train, self.count)

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.train.sample_rate

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the mean of the nearest training contacts' sounds."""
        if not self.by_direction or directions is None or self.train.directions is None:
            return self.train.sounds[nearest_points(self.train.contacts, contacts, count=self.count)].mean(dim=1)
        known = Sites(self.train.contacts.double(), normalize(self.train.directions.double()))
        asked = Sites(contacts.double(), normalize(directions.double()))
        size = float((known.points.amax(0) - known.points.amin(0)).norm())
        rows, signs = nearest_sites(asked, known, size=size, count=self.count)
        signs = signs.to(self.train.sounds.dtype)
        return (signs[:, :, None] * self.train.sounds[rows]).mean(dim=1)


@dataclass(frozen=True, eq=False)
class MeanGains(ModalBaseline):
    """The modes with the mean of the nearest contacts' signed gains, in phase and in quadrature."""

    count: int = 3
    """How many contacts' gains are averaged."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _expect_neighbors(self.train, self.count)

    def amplitudes_at(self, contacts: Float[Tensor, "contacts 3"]) -> Float[Tensor, "contacts two_modes"]:
        """Return the mean of the nearest training contacts' gains in phase, then in quadrature."""
        return self.amplitudes[nearest_points(self.train.contacts, contacts, count=self.count)].mean(dim=1)


@dataclass(frozen=True, eq=False)
class RandomImpact:
    """One recording of another object, the same at every contact: what a listener makes of any struck thing."""

    sound: Float[Tensor, " samples"]
    """The other object's recording, in its own unit, as long as the sounds that it is compared with."""
    sample_rate: float
    """Samples per second, Hz."""

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the recording for every contact."""
        return self.sound.expand(len(contacts), -1)


def floor(test: Impacts, bank: ModalBank) -> Float[Tensor, "contacts samples"]:
    """Return the test sounds as `bank` expresses them best: their own gains, in phase and in quadrature.

    No gains that are predicted for the same modes come nearer in the squared error of the waveform.
    """
    gains, quadrature = fit_gains(test.sounds, bank, sample_rate=test.sample_rate)
    return _render(test, bank, gains, quadrature)


def sine_floor(test: Impacts, bank: ModalBank) -> Float[Tensor, "contacts samples"]:
    """Return the test sounds as damped sines without cosines express them best: all that the paper's equation 3 has."""
    gains = fit_sine_gains(test.sounds, bank, sample_rate=test.sample_rate)
    return _render(test, bank, gains, None)


def _render(
    test: Impacts,
    bank: ModalBank,
    gains: Float[Tensor, "contacts modes"],
    quadrature: Float[Tensor, "contacts modes"] | None,
) -> Float[Tensor, "contacts samples"]:
    return synthesize(
        gains,
        bank.frequency,
        bank.damping,
        samples=test.sounds.shape[1],
        sample_rate=test.sample_rate,
        quadrature=quadrature,
    )


def _expect_neighbors(train: Impacts, count: int) -> None:
    if not 1 <= count <= len(train):
        raise EvaluationError(
            f"expected a count of 1 to {len(train)} nearest training impacts, got {count}", name="count", value=count
        )
