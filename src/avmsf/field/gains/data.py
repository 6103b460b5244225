"""What gain models are fitted to: recordings whose modes and gains are known, checked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Complex, Complex128, Float, Float64
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.extraction.stft import ShortTime
from avmsf.modal.modes import common_phase
from avmsf.modal.residual_noise import Residual, noise_power

_OPPOSED = -0.5
"""Cosine between two neighbors' directions below which one of them comes from the other side: 120 degrees and more."""


@dataclass(frozen=True, eq=False)
class GainData:
    """Recordings whose gains are known at their contacts."""

    train: Impacts
    """Aligned, in float32."""
    features: FeatureField
    """Points of the object, and what is known of them."""
    modes: Extraction
    """The modes of `train`, row for row."""
    phase: Float64[Tensor, " modes"]
    """How each mode starts, radians."""
    gains: Float[Tensor, "contacts modes"]
    """The network's aim: amplitudes of what starts with the phase, times `orientation_signs`, or regressed ones."""
    config: FitConfig

    @property
    def values(self) -> Complex128[Tensor, "contacts modes"]:
        """The extracted gains: amplitudes along each mode's phase, and a quarter of a period ahead of it."""
        return along_phase(self.modes.gains, self.phase)

    def divided(self, levels: Float64[Tensor, " contacts"]) -> "GainData":
        """Return the data of the recordings over levels, which take the place of their forces."""
        by = levels[:, None].to(self.train.sounds)
        train = replace(self.train, sounds=self.train.sounds / by, forces=levels.to(by))
        modes = replace(self.modes, gains=self.modes.gains / by.to(self.modes.gains.real))
        return replace(self, train=train, modes=modes, gains=self.gains / by)

    def take(self, rows: Sequence[int]) -> "GainData":
        """Return the data of some of the recordings, with the same modes and phases."""
        return replace(self, train=self.train.take(rows), modes=self.modes.take(rows), gains=self.gains[list(rows)])


def gain_data(train: Impacts, features: FeatureField, modes: Extraction, config: FitConfig) -> GainData:
    """Return what gain models are fitted to. Raises FitError for recordings and modes that none can be fitted to."""
    _expect_fitting(train, modes)
    # The alignment comes first, as it recognizes recordings by their samples. Amplitudes are float32 from there on, so
    # that a field is the same whichever its recordings came in.
    train = modes.aligned(train)
    sounds = modes.at_common_poles(train.sounds, sample_rate=train.sample_rate)
    train = replace(train, sounds=sounds.float())
    modes = replace(modes, residual=Residual(modes.residual.magnitude.float()))
    phase = torch.zeros_like(modes.bank.frequency)
    if config.phase == "common":
        phase = common_phase(modes.gains)
    if config.residual_start == "quietest":
        power = noise_power(train.sounds, bins=len(modes.residual.magnitude)).mean(0)
        modes = replace(modes, residual=Residual(power.sqrt()))
    signs = orientation_signs(train.contacts, train.directions)[:, None]
    if config.warmup_steps and config.warmup_gains == "regression":
        gains = ShortTime().gains(train.sounds, modes.bank, train.sample_rate).float()
    elif config.warmup_steps:
        gains = signs * fit_sine_gains(train.sounds, modes.bank, sample_rate=train.sample_rate, phase=phase)
    else:
        # No aim then, they only say how strong the modes are: what of the extraction's own has the phase does.
        turned = modes.gains.real * torch.cos(phase) + modes.gains.imag * torch.sin(phase)
        gains = signs * turned.to(train.sounds)
    return GainData(train, features, modes, phase, gains, config)


def along_phase(
    gains: Complex[Tensor, "contacts modes"], phase: Float64[Tensor, " modes"]
) -> Complex128[Tensor, "contacts modes"]:
    """Return gains relative to each mode's phase, radians: the real part along it, the imaginary one 90 deg ahead."""
    return gains.to(torch.complex128) * torch.polar(torch.ones_like(phase), -phase)


def orientation_signs(
    contacts: Float[Tensor, "contacts 3"], directions: Float[Tensor, "contacts 3"] | None
) -> Float[Tensor, " contacts"]:
    """Return +1 or -1 a contact, such that directions times these vary as little as they can from contact to contact.

    A linear object answers an opposite force with the negated sound, so impacts on the two sides of a thin wall have
    opposite gains. A field that knows places alone can be fitted to the gains times these signs. Along the shortest
    tree that connects the contacts, a direction opposed to its neighbor's turns the sign. Most contacts keep +1. All
    ones where `directions` is None.
    """
    count = len(contacts)
    if directions is None or count < 2:
        return torch.ones(count, dtype=torch.float32)
    places = contacts.detach().double().cpu().numpy()
    # Contacts in one place are at distance zero, which the sparse graph would take for no edge.
    tree = minimum_spanning_tree(cdist(places, places) + 1e-9)
    order, parents = breadth_first_order(tree, 0, directed=False)
    cosines = (directions.double() @ directions.double().T).cpu().numpy()
    signs = np.ones(count)
    for row in order[1:]:
        signs[row] = signs[parents[row]] * (-1.0 if cosines[row, parents[row]] < _OPPOSED else 1.0)
    return torch.from_numpy(-signs if signs.sum() < 0 else signs).float()


def gain_variance(data: GainData) -> Float64[Tensor, " modes"]:
    """Return the variance that the background noise gives each part of a gain by least squares.

    White noise of variance v at a sample rate r leaves each part of a damped sine's amplitude with the variance
    2 v / (r E), E = (1 - exp(-2 d T)) / (2 d) being the energy of its envelope over the duration T; around a mode's
    frequency the residual is as good as white.
    """
    bank, magnitude = data.modes.bank, data.modes.residual.magnitude.double()
    place = bank.frequency / (data.train.sample_rate / 2) * (len(magnitude) - 1)
    noise = magnitude[place.round().long().clamp(0, len(magnitude) - 1)].square()
    envelope = -torch.expm1(-2.0 * bank.damping * data.train.duration) / (2.0 * bank.damping)
    return 2.0 * noise / (data.train.sample_rate * envelope)


def _expect_fitting(train: Impacts, modes: Extraction) -> None:
    finite = torch.isfinite(train.sounds).all(1) & torch.isfinite(train.contacts).all(1)
    if train.directions is not None:
        finite &= torch.isfinite(train.directions).all(1)
    if not bool(finite.all()):
        row = int(finite.int().argmin())
        wanted, advice = "finite samples, coordinates and directions", "remove the recording; directions may be zeros"
        raise FitError.expected(wanted, got="NaN or infinity", row=row, name=train.names[row], advice=advice)
    if train.forces is not None and not bool((train.forces > 0.0).all()):
        row = int((train.forces > 0.0).int().argmin())
        force, name = float(train.forces[row]), train.names[row]
        raise FitError.expected("a force above 0", force, row=row, name=name, advice="give peak forces, or none at all")
    if float(train.sounds.abs().max()) == 0.0:
        raise FitError.expected("sound", "silence", name="train", advice="check the channel")
    advice = "extract the modes from the recordings that the field is fitted to"
    if len(modes.gains) != len(train):
        raise FitError.expected(f"gains of {len(train)} recordings", len(modes.gains), name="modes", advice=advice)
    if len(modes.bank) == 0:
        raise FitError.expected("1 mode or more", 0, got="none", name="modes", advice="record longer or louder")
    highest, limit = float(modes.bank.frequency.max()), train.sample_rate / 2
    if highest >= limit:
        raise FitError.expected(f"frequencies below {limit:g} Hz", highest, name="modes", advice=advice)
