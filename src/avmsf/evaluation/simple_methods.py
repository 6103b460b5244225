"""Baselines made of the training recordings, and what an object's modes alone reach.

Each baseline is a `Renderer`; nearest is by Euclidean distance, and of equally near contacts the first.
"""

import zlib
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Complex128, Float, Float64
from scipy.interpolate import RBFInterpolator
from torch import Tensor
from torch.nn.functional import normalize

from avmsf.capture.impacts import Impacts, places_of
from avmsf.evaluation.task import Amplitudes, Contacts, Sounds, Task
from avmsf.field.gains.data import orientation_signs
from avmsf.field.gains.kernels import Axes, Sites
from avmsf.mesh.points import nearest_points
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank, synthesize
from avmsf.modal.residual_noise import shape_noise

_Baseline = TypeVar("_Baseline", bound="_Trained")


@dataclass(frozen=True, eq=False)
class _Trained:
    """What is made of the training impacts alone."""

    train: Impacts

    @classmethod
    def of(cls: type[_Baseline], task: Task, **settings: Any) -> _Baseline:
        """Return the baseline of a task's training recordings."""
        return cls(task.train, **settings)

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.train.sample_rate


@dataclass(frozen=True, eq=False)
class ModalBaseline(_Trained, ABC):
    """Modes of the training impacts, with gains that are made of the training contacts' own."""

    extraction: Extraction
    """Modes of the training impacts, and their gains in each of them, row for row."""
    noise: bool = field(default=False, kw_only=True)
    """Whether the extraction's residual is added to the modes, as it is in a field: one draw for all contacts."""
    seed: int = field(default=0, kw_only=True)
    """Start of the noise's chance."""

    @classmethod
    def of(cls: type[_Baseline], task: Task, **settings: Any) -> _Baseline:
        """Return the baseline of a task's modes, with their noise."""
        return cls(task.train, task.modes(), noise=True, seed=task.seed, **settings)  # type: ignore[call-arg]

    @property
    def bank(self) -> ModalBank:
        """The modes, the same at all contacts."""
        return self.extraction.bank

    @cached_property
    def amplitudes(self) -> Amplitudes:
        """The training contacts' amplitudes, as if all impacts came from the same side.

        Of two impacts from opposite sides of a thin wall the gains are opposite too, and their mean would be silence.
        """
        amplitudes = -1j * self.extraction.gains
        return amplitudes * orientation_signs(self.train.contacts, self.train.directions).to(amplitudes)[:, None]

    @abstractmethod
    def complex_gains(self, contacts: Contacts, *, directions: Contacts | None = None) -> Amplitudes:
        """Return amplitudes A at the contacts: their sounds are the real part of the sum of A exp((-d + 2 pi i f) t).

        `directions` make no difference.
        """

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the modes' sound at each contact, and the noise where there is any."""
        amplitudes, samples = self.complex_gains(contacts), self.train.sounds.shape[1]
        bank, rate = self.bank, self.train.sample_rate
        sounds = synthesize(1j * amplitudes, bank.frequency, bank.damping, samples=samples, sample_rate=rate)
        if not self.noise:
            return sounds
        generator = torch.Generator().manual_seed(self.seed)
        magnitude = self.extraction.residual.magnitude
        return sounds + shape_noise(magnitude, contacts=1, samples=samples, generator=generator)


@dataclass(frozen=True, eq=False)
class WhiteNoise(_Trained):
    """Gaussian white noise at the mean level of the training sounds, different for each contact.

    The level is the root mean square over the sound. (The paper says the same of its white noise, but its values are
    those of noise of peak one: see `avmsf.evaluation.metrics`.)
    """

    seed: int = 0

    @classmethod
    def of(cls, task: Task, **settings: Any) -> "WhiteNoise":
        """Return the noise of a task's seed."""
        return cls(task.train, task.seed, **settings)

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return noise that depends only on the seed and the contact."""
        loudness = self.train.sounds.square().mean(dim=1).sqrt().mean()
        sounds = [self._noise(contact) for contact in contacts]
        return torch.stack(sounds) * loudness if sounds else self.train.sounds[:0]

    def _noise(self, contact: Float[Tensor, "3"]) -> Float[Tensor, " samples"]:
        # Adding zero makes one of the two zeros, whose bytes differ.
        position = (contact.detach().double().cpu() + 0.0).numpy().tobytes()
        # One hash of both, since torch's generator uses only the lower 32 bits of its seed.
        generator = torch.Generator().manual_seed(zlib.crc32(position, self.seed))
        noise = torch.randn(self.train.sounds.shape[1], generator=generator, dtype=self.train.sounds.dtype)
        return noise.to(self.train.sounds.device)


@dataclass(frozen=True, eq=False)
class NearestRecording(_Trained):
    """The training sound whose contact is nearest."""

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the nearest training contact's sound."""
        return self.train.sounds[nearest_points(self.train.contacts, contacts)[:, 0]]


@dataclass(frozen=True, eq=False)
class MeanWaveform(_Trained):
    """The mean of the nearest training sounds, sample by sample: the paper's KNN. Phases cancel in it.

    With `by_direction`, where the directions of both sides are known, an impact's direction is part of where it is
    (`Sites.nearest`; the size is the diagonal of the box around the training contacts).
    """

    count: int = 3
    """How many sounds are averaged."""
    by_direction: bool = False
    """Whether directions count as well as contacts."""

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the mean of the nearest training contacts' sounds."""
        count = min(self.count, len(self.train))
        if not self.by_direction or directions is None or self.train.directions is None:
            return self.train.sounds[nearest_points(self.train.contacts, contacts, count=count)].mean(dim=1)
        known = Sites(self.train.contacts.double(), normalize(self.train.directions.double()))
        asked = Sites(contacts.double(), normalize(directions.double()))
        size = float((known.points.amax(0) - known.points.amin(0)).norm())
        rows, signs = asked.nearest(known, size=size, count=count)
        return (signs[:, :, None].to(self.train.sounds) * self.train.sounds[rows]).mean(dim=1)


@dataclass(frozen=True, eq=False)
class MeanGains(ModalBaseline):
    """The modes with the mean of the nearest contacts' amplitudes."""

    count: int = 3
    """How many contacts' amplitudes are averaged."""

    def complex_gains(self, contacts: Contacts, *, directions: Contacts | None = None) -> Amplitudes:
        """Return the mean of the nearest training contacts' amplitudes."""
        count = min(self.count, len(self.train))
        nearest = self.amplitudes[nearest_points(self.train.contacts, contacts, count=count)]
        return torch.complex(nearest.real.mean(dim=1), nearest.imag.mean(dim=1))


@dataclass(frozen=True, eq=False)
class RandomImpact:
    """One sound, such as a recording of another object, the same at every contact."""

    sound: Float[Tensor, " samples"]
    """In its own unit, as long as the sounds that it is compared with."""
    sample_rate: float
    """Samples per second, Hz."""

    @classmethod
    def of(cls, task: Task) -> "RandomImpact":
        """Return a recording of another object than a task's."""
        return cls(task.other_recording(), task.train.sample_rate)

    def render(self, contacts: Contacts, *, directions: Contacts | None = None) -> Sounds:
        """Return the sound for every contact."""
        return self.sound.expand(len(contacts), -1)


def floor(test: Impacts, bank: ModalBank) -> Float[Tensor, "contacts samples"]:
    """Return the test sounds as `bank` expresses them best: their own complex gains, without noise.

    No gains that are predicted for the same modes come nearer in the squared error of the waveform; a field with noise
    can have less error in a spectrum.
    """
    rate, samples = test.sample_rate, test.sounds.shape[1]
    gains = fit_gains(test.sounds, bank, sample_rate=rate)
    return synthesize(gains, bank.frequency, bank.damping, samples=samples, sample_rate=rate)


@dataclass(frozen=True, eq=False)
class SplineGains(ModalBaseline):
    """The modes with amplitudes that are thin-plate splines through the training contacts.

    Contacts in one position count once, with their mean amplitudes. With fewer positions than twice what determines a
    linear function the spline is linear in the distance, with a constant: the thin plate would run away beyond them.
    """

    def complex_gains(self, contacts: Contacts, *, directions: Contacts | None = None) -> Amplitudes:
        """Return the splines' amplitudes."""
        positions, means = self._positions
        axes = Axes(positions)
        along, asked = axes.along(positions), axes.along(contacts.double())
        if len(positions) == 1 or not along.shape[1]:
            return means.mean(0, keepdim=True).expand(len(contacts), -1).to(self.amplitudes)
        kernel, degree = ("thin_plate_spline", 1) if len(positions) >= 2 * (along.shape[1] + 1) else ("linear", 0)
        spline = RBFInterpolator(along.numpy(), means.numpy(), kernel=kernel, degree=degree)
        return torch.from_numpy(np.asarray(spline(asked.numpy()))).to(self.amplitudes)

    @cached_property
    def _positions(self) -> tuple[Float64[Tensor, "positions 3"], Complex128[Tensor, "positions modes"]]:
        """Distinct positions, and the mean amplitudes there."""
        owner = places_of(self.train.contacts.double())
        members = (owner[None, :] == torch.arange(int(owner.max()) + 1)[:, None]).double()
        mean = members / members.sum(1, keepdim=True)
        return mean @ self.train.contacts.double(), mean.to(torch.complex128) @ self.amplitudes.to(torch.complex128)
