"""An object's sound at every contact: modes, a gain field, and noise."""

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Complex, Float, Float64
from torch import Tensor

from avmsf._utils.arrays import ArrayLike, as_count, as_directions, as_forces, as_vectors, short_repr
from avmsf.capture.impacts import Impacts
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import FitError, PositionWarning
from avmsf.field.config import FitConfig
from avmsf.field.gains.mixture_gains import NEIGHBORS, MixtureGains
from avmsf.field.gains.model import GainModel, Gains, expect_near, off_surface
from avmsf.field.quality import FieldQuality, ProbableBody
from avmsf.modal.extraction.alignment import Alignment
from avmsf.modal.modes import ForcePulse, ModalBank, synthesize
from avmsf.modal.residual_noise import MEDIAN_LEVEL, Residual, low_fluctuation_noise, missing_background, shape_noise

SUPPORTING = "supporting_poles"
"""What a report calls the rows of the bank's poles that are no modes of the object."""
_BATCH = 32
"""Contacts rendered at once, which bounds the memory."""
_LEVEL_POINTS = 256
"""Points of the object that a mode's level is taken over, at most."""
_MAX_MAPPED_POINTS = 1000
"""Points that the mean over the surface is taken over, at most."""


@dataclass(frozen=True)
class Origin:
    """Where a field comes from."""

    __repr__ = short_repr

    capture: str = ""
    """Name of the capture."""
    trained_on: tuple[str, ...] = ()
    """Names of the recordings that it was fitted to."""
    per_newton: bool = False
    """Whether the recordings were divided by the force, so that a force in newtons scales an impact's sound."""
    config: FitConfig = field(default_factory=FitConfig)
    """Settings of the fit."""
    report: dict[str, Any] = field(default_factory=dict)
    """What the fit chose and reached, as plain numbers and text."""
    settings: CaptureSettings = field(default_factory=CaptureSettings)
    """By which its recordings were read."""


@dataclass(frozen=True, eq=False)
class GainPosterior:
    """The posterior of complex gains A, -i times `Extraction.gains`: real parts of A exp((-d + 2 pi i f) t) sound."""

    __repr__ = short_repr

    mean: Complex[Tensor, "contacts modes"]
    """In the unit of the training sounds."""
    std: Float[Tensor, "contacts modes"]
    """Standard deviation: the square root of the expected squared distance of a gain from its mean."""


@dataclass(frozen=True, eq=False)
class SoundField:
    """Renders the sound of an impact anywhere on one object (paper, eq. 4).

    Positions, directions and forces are lists, numpy arrays or tensors. Methods raise ArrayError for other shapes and
    for values that are not finite, and PositionError for a position that lies farther from the object than this is
    large. For one nearer but off the object by more than 5 % of its diagonal they give a PositionWarning. Directions of
    any length count as unit vectors. One of length zero is unknown, and the impact then goes straight into the surface.

    `bank` has the modes' frequencies and dampings, `samples` is the length of rendered sounds, at `sample_rate` Hz.
    """

    bank: ModalBank
    """Frequencies and dampings, shared by all contacts."""
    gain_field: GainModel
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
    alignment: Alignment | None = None
    """How the recordings that it was fitted to were aligned with one another; None where they were not."""

    def __repr__(self) -> str:
        fitted, seconds = len(self.origin.trained_on), self.samples / self.sample_rate
        text = (
            f"SoundField({self.origin.capture!r}, {self.bank}, gains {self.gain_field.kind!r} of {fitted} recordings, "
            f"{seconds:.3g} s at {self.sample_rate:g} Hz)"
        )
        quality, body = self.quality, self.body
        if quality is not None:
            nearest = "" if quality.nearest is None else f", nearest recording {quality.nearest:.2f}"
            text += f"\nleave-one-out error {quality.error:.2f}{nearest}, mean of 3 nearest {quality.nearest_mean:.2f}"
        return f"{text}\n{body.warning}" if body is not None and body.warning else text

    @property
    def quality(self) -> FieldQuality | None:
        """How well its contacts are predicted from one another.

        None for few points, for the attention network, and for an edited field, which has no recordings.
        """
        found = None if self.origin.report.get("edits") else self.origin.report.get("quality")
        return FieldQuality.of(found) if isinstance(found, dict) else None

    @property
    def body(self) -> ProbableBody | None:
        """The most probable body behind the surface, with a warning where no material could be so stiff.

        None where no body predicts the contacts from one another, and for an edited field.
        """
        return None if self.origin.report.get("edits") else ProbableBody.of(self.origin.report)

    @property
    def audible(self) -> Bool[Tensor, " modes"]:
        """Which modes sound: those below half the sample rate, above which an edit may have moved some."""
        return self.bank.frequency < 0.5 * self.sample_rate

    @property
    def is_mode(self) -> Bool[Tensor, " modes"]:
        """Which of the bank's poles are modes of the object; the others support the model of the recordings.

        True for all where the report does not say it: in a field without recordings, or made without the pipeline.
        """
        mask = torch.ones(len(self.bank), dtype=torch.bool)
        mask[self.origin.report.get(SUPPORTING, [])] = False
        return mask

    @cached_property
    def amplitudes(self) -> Float64[Tensor, " modes"]:
        """Root mean square amplitude of each mode over the object; zero for those that do not sound."""
        points = self.gain_field.points
        known = self.known(points[:: max(1, -(-len(points) // _LEVEL_POINTS))])
        return torch.where(self.audible, known.power.mean(0).sqrt(), 0.0)

    @property
    def scale(self) -> Float64[Tensor, " modes"]:
        """The gains over the fitted ones: 1, or what an edit has made of each mode."""
        return torch.ones(len(self.bank), dtype=torch.float64) * self.gain_field.scale

    @property
    def has_posterior(self) -> bool:
        """Whether the uncertainty of the gains is known."""
        gains = self.gain_field.fitted
        return isinstance(gains, MixtureGains) and gains.place_count >= 2

    @property
    def fitted_mixture(self) -> MixtureGains:
        """The gain model that the field was fitted with, beneath its edits.

        Raises FitError where its uncertainty is not known: for the attention network, a guess without recordings, and
        contacts in a single place.
        """
        gains = self.gain_field.fitted
        if not isinstance(gains, MixtureGains):
            wanted, advice = f"gains of the kind {MixtureGains.kind!r}", "fit recordings with --gain-model auto"
            raise FitError.expected(wanted, gains.kind, name="field", advice=advice)
        if gains.place_count < 2:
            wanted, advice = "recordings at 2 positions or more", "record impacts at another position"
            raise FitError.expected(wanted, gains.place_count, name="field", advice=advice)
        return gains

    def save(self, path: str | Path) -> None:
        """Write the field to one safetensors file. Raises FieldFileError where it cannot be written."""
        from avmsf.field.store import save

        save(self, path)

    def posterior(self, positions: ArrayLike, directions: ArrayLike | None = None) -> GainPosterior:
        """Return the posterior of the gains of impacts.

        Args:
            positions: [contacts, 3], object frame, meters.
            directions: As in `render`.

        Returns:
            Mean and standard deviation [contacts, modes], in the unit of the training sounds.

        Raises:
            FitError: For a field without a posterior: of the attention network, of recordings in one place, or guessed
                without recordings.
        """
        _ = self.fitted_mixture
        known = self.gain_field.posterior(*self._impacts(positions, directions))
        assert known.std is not None
        return GainPosterior(self._amplitudes(known), known.std.double().square().sum(2).sqrt())

    def relative_gain_std(self, points: ArrayLike) -> Float64[Tensor, " points"]:
        """Return the standard deviation of the gains at points (meters) over their root mean square on the object.

        Both as energy over all modes: 0 is certainty; points that may be louder than the mean can have more than 1.
        Points off the object give no warning. Raises as `fitted_mixture`.
        """
        points, _ = self._impacts(points, warn=False)
        _, surface = self.fitted_mixture, self.gain_field.points
        step = max(1, len(surface) // _MAX_MAPPED_POINTS)
        energy = self.energy(self.gain_field.predict(surface[::step]).parts).mean()
        std = self.gain_field.posterior(points).std
        assert std is not None
        return (self.energy(std) / energy.clamp_min(torch.finfo(torch.float64).tiny)).sqrt()

    def energy(self, parts: Float[Tensor, "contacts modes 2"]) -> Float64[Tensor, " contacts"]:
        """Return the energy of gains in two parts: the sum over audible modes of squares over four dampings."""
        return (parts.double().square().sum(2) * self.audible / (4.0 * self.bank.damping.double())).sum(1)

    def aligned(self, impacts: Impacts) -> Impacts:
        """Return recordings of the object with the starts that the field's sounds have; as they are at another rate."""
        if self.alignment is None or impacts.sample_rate != self.sample_rate:
            return impacts
        return self.alignment.apply(impacts)

    def gains(self, contacts: ArrayLike, *, directions: ArrayLike | None = None) -> Float[Tensor, "contacts modes"]:
        """Return the signed amplitudes at the contacts (object frame, meters), in the unit of the training sounds.

        They are those along each mode's phase; `complex_gains` has what is ahead of it too.
        `directions`, unit vectors, are those of the impacts; without them they go straight into the surface.
        """
        return self.gain_field.point_estimate(*self._impacts(contacts, directions, "contacts")).mean.real

    def complex_gains(
        self, contacts: ArrayLike, *, directions: ArrayLike | None = None
    ) -> Complex[Tensor, "contacts modes"]:
        """Return amplitudes A at the contacts: their sounds are the real part of the sum of A exp((-d + 2 pi i f) t).

        -i times `Extraction.gains`; contacts, directions and unit as in `gains`, dampings d those of the contacts.
        """
        return self._amplitudes(self.gain_field.point_estimate(*self._impacts(contacts, directions, "contacts")))

    def known(self, contacts: ArrayLike, *, directions: ArrayLike | None = None) -> Gains:
        """Return all that a sound needs at the contacts: both parts of the gains, and the factors on the dampings.

        Contacts, directions and unit as in `gains`. Raises PositionError for a contact far from the object.
        """
        return self.gain_field.point_estimate(*self._impacts(contacts, directions, "contacts", warn=False))

    def render(
        self,
        positions: ArrayLike,
        directions: ArrayLike | None = None,
        forces: float | int | ArrayLike | None = None,
        *,
        samples: int | None = None,
        pulse: ForcePulse | None = None,
        noise: bool = True,
    ) -> Float[Tensor, "contacts samples"]:
        """Return the sound of an impact at each position.

        The noise is the same at every contact and in every call, so that a contact's sound depends on nothing else.
        Modes that are not `audible` are silent. Background noise does not grow with the force (`Residual.force`); what
        the nearest recordings have in addition to their modes does, as does the noise of the paper's residual. Where
        their mean is rendered, noise is added as far as the background in it is too weak.

        Args:
            positions: [contacts, 3], object frame, meters.
            directions: Unit vectors [contacts, 3] of the impacts. One of [0, 0, 0] is unknown, as in tables of
                contacts: the impact goes straight into the surface, as all do without `directions`.
            forces: One for all or one for each, 0 or more, in newtons where the recordings were divided by theirs, else
                relative to an average one of them. By default sounds are as the training recordings on average, divided
                by the force where these were.
            samples: Length of the sounds, by default that of the training sounds.
            pulse: What a softer hammer adds to the recorded impacts' own pulses; it has the same impulse, however long
                it is, and leaves the noise as it is.
            noise: Whether the residual noise is added to the modes.

        Returns:
            Sounds [contacts, samples] at `sample_rate`: with `forces` as recorded, else in the unit of the training
            sounds.
        """
        contacts, vectors = self._impacts(positions, directions)
        length = self.samples if samples is None else as_count(samples, "samples")
        recorded, average = noise and self.residual.recordings is not None, self.residual.force
        stationary = noise and not (recorded and average is None)
        background = self.noise(length) if stationary else torch.zeros(length)
        parts = [torch.zeros(0, length)]
        for rows in torch.split(torch.arange(len(contacts)), _BATCH):
            vector = None if vectors is None else vectors[rows]
            modes = self.modal_sounds(self.gain_field.point_estimate(contacts[rows], vector), length)
            sounds = modes if pulse is None else pulse.soften(modes, sample_rate=self.sample_rate)
            parts.append(sounds + self._recorded(contacts[rows], vector, length) if recorded else sounds)
        sounds = torch.cat(parts)
        usual = average or 1.0
        given = as_forces(usual if forces is None else forces, "forces", count=len(contacts))[:, None].to(sounds)
        if average is None:
            return given * (sounds + background)
        if recorded:
            background = missing_background(given / average, NEIGHBORS) * background
        return sounds + background if forces is None else given * sounds + average * background

    def _impacts(
        self, positions: ArrayLike, directions: ArrayLike | None = None, name: str = "positions", *, warn: bool = True
    ) -> tuple[Float[Tensor, "contacts 3"], Float[Tensor, "contacts 3"] | None]:
        """Return positions and directions as tensors. Raises PositionError; warns of positions off the object."""
        contacts = as_vectors(positions, name)
        expect_near(contacts, self.gain_field.points, name=name)
        off = off_surface(contacts, self.gain_field) if warn else []
        if off:
            row, distance = max(off, key=lambda each: each[1])
            wanted, got = "positions on the object", f"{len(off)} off it, this one by {1e3 * distance:.3g} mm"
            found = PositionWarning.expected(wanted, distance, got=got, name=name, row=row)
            warnings.warn(found, stacklevel=3)
        vectors = None if directions is None else as_directions(directions, "directions", count=len(contacts))
        return contacts, vectors

    def _amplitudes(self, known: Gains) -> Complex[Tensor, "contacts modes"]:
        return -1j * known.mean.to(torch.complex128) * torch.exp(1j * self.phase)

    def _recorded(
        self, contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None, samples: int
    ) -> Float[Tensor, "contacts samples"]:
        """Return the mean of what the nearest recordings have in addition to their modes; silence after their end."""
        gains, recordings = self.gain_field.fitted, self.residual.recordings
        assert isinstance(gains, MixtureGains)
        assert recordings is not None
        rows, signs = gains.nearest(gains.sites(contacts.double() / self.gain_field.length, directions))
        found = (recordings[rows] * signs[..., None]).mean(1).float()[:, :samples]
        return torch.nn.functional.pad(found, (0, samples - found.shape[1]))

    def noise(self, samples: int | None = None) -> Float[Tensor, " samples"]:
        """Return the residual noise that `render` adds without forces; `samples` as there.

        Of the kind that the fit's configuration names: a fixed sequence of low fluctuation, or a Gaussian draw
        (paper, eq. 6), which differs with `samples`.
        """
        length = self.samples if samples is None else as_count(samples, "samples")
        if self.origin.config.residual_noise == "low-fluctuation":
            level = 1.0 if self.residual.force is None else MEDIAN_LEVEL
            return level * low_fluctuation_noise(self.residual.magnitude, samples=length)
        generator = torch.Generator().manual_seed(self.origin.config.seed)
        return shape_noise(self.residual.magnitude, contacts=1, samples=length, generator=generator)[0]

    def modal_sounds(self, known: Gains, samples: int) -> Float[Tensor, "contacts samples"]:
        """Return the sounds of the audible modes with these gains, without noise."""
        rows = torch.nonzero(self.audible).flatten()
        return synthesize(
            known.mean[:, rows],
            self.bank.frequency[rows],
            known.dampings(self.bank.damping)[..., rows],
            self.phase[rows],
            samples=samples,
            sample_rate=self.sample_rate,
        )
