"""What a gain field is made from, and the ways to make one."""

import hashlib
import json
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.distance import cdist
from torch import Tensor

from avmsf._utils.caching import source_digest
from avmsf.capture.impacts import Impacts
from avmsf.errors import FitError
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.gains.attention import AttentionGains
from avmsf.field.training import TrainableGains, gain_scale
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.extraction.finders import ShortTime
from avmsf.modal.extraction.least_squares import fit_sine_gains
from avmsf.modal.modes import common_phase
from avmsf.modal.residual_noise import Residual, noise_power

SHARED, PER_CONTACT = "shared", "per-contact"
"""Dampings that are the same everywhere, and those that vary with the contact."""
_OPPOSED = -0.5
"""Cosine between two neighbors' directions below which one of them comes from the other side: 120 degrees and more."""


@dataclass(frozen=True, eq=False)
class GainCase:
    """Recordings whose gains are known, to be spread over an object."""

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
    def parts(self) -> Float64[Tensor, "contacts modes 2"]:
        """The amplitudes along each mode's phase and a quarter of a period ahead of it."""
        return along_phase(self.modes.gains, self.modes.quadrature, self.phase)

    def take(self, rows: list[int]) -> "GainCase":
        """Return the case of some of the recordings, with the same modes and phases."""
        modes = replace(self.modes, gains=self.modes.gains[rows], quadrature=self.modes.quadrature[rows])
        return replace(self, train=self.train.take(rows), modes=modes, gains=self.gains[rows])


def gain_case(train: Impacts, features: FeatureField, modes: Extraction, config: FitConfig) -> GainCase:
    """Return what gain fields are made from. Raises FitError where no field can be fitted to recordings and modes."""
    _expect_fitting(train, modes)
    # The alignment comes first, as it recognizes recordings by their samples. Amplitudes are float32 from there on, so
    # that a field is the same whichever its recordings came in.
    train = modes.aligned(train)
    train = replace(train, sounds=train.sounds.float())
    modes = replace(modes, residual=Residual(modes.residual.magnitude.float()))
    phase = torch.zeros_like(modes.bank.frequency)
    if config.phase == "common":
        phase = common_phase(modes.gains, modes.quadrature)
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
        turned = modes.gains * torch.cos(phase) + modes.quadrature * torch.sin(phase)
        gains = signs * turned.to(train.sounds)
    return GainCase(train, features, modes, phase, gains, config)


def along_phase(
    gains: Float[Tensor, "contacts modes"],
    quadrature: Float[Tensor, "contacts modes"],
    phase: Float64[Tensor, " modes"],
) -> Float64[Tensor, "contacts modes 2"]:
    """Return amplitudes of sines and cosines as those along each mode's phase (radians) and a quarter period ahead."""
    both = torch.complex(gains.double(), quadrature.double())
    return torch.view_as_real(both * torch.polar(torch.ones_like(phase), -phase))


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
        return torch.ones(count)
    places = contacts.detach().double().cpu().numpy()
    # Contacts in one place are at distance zero, which the sparse graph would take for no edge.
    tree = minimum_spanning_tree(cdist(places, places) + 1e-9)
    order, parents = breadth_first_order(tree, 0, directed=False)
    cosines = (directions.double() @ directions.double().T).cpu().numpy()
    signs = np.ones(count)
    for row in order[1:]:
        signs[row] = signs[parents[row]] * (-1.0 if cosines[row, parents[row]] < _OPPOSED else 1.0)
    return torch.from_numpy(-signs if signs.sum() < 0 else signs).float()


class GainRecipe(ABC):
    """A way to make a gain field; unless it says otherwise, one that solves for gains with shared dampings."""

    warms_up: ClassVar[bool] = False
    """Whether gains have to be learned before the end-to-end stage, step by step (paper, eq. 13)."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What reports, tables and the command line call it."""

    @abstractmethod
    def digest(self) -> str:
        """Return what distinguishes this recipe from others, besides the config."""

    @abstractmethod
    def start(self, case: GainCase, damping: str) -> TrainableGains:
        """Return the field as it is before training. Raises AvmsfError where it cannot be had."""

    def dampings(self, config: FitConfig) -> tuple[str, ...]:
        """Return the forms of damping to choose from."""
        return (SHARED,)

    def rows(self, case: GainCase) -> Int[Tensor, " contacts"]:
        """Return what the field reads for the case's contacts."""
        return torch.arange(len(case.train))


@dataclass(frozen=True, eq=False)
class Attention(GainRecipe):
    """The paper's network, on the features of the fit or on its own."""

    features: FeatureField | None = None
    """What it reads in place of the fit's features."""
    name: str = "attention"
    warms_up: ClassVar[bool] = True

    def digest(self) -> str:
        """Return the name and the digest of the network's own features."""
        return f"attention {'' if self.features is None else self.features.digest()}"

    def dampings(self, config: FitConfig) -> tuple[str, ...]:
        """Return the config's damping, or both where it leaves that to validation."""
        return (SHARED, PER_CONTACT) if config.damping == "validated" else (config.damping,)

    def start(self, case: GainCase, damping: str) -> AttentionGains:
        """Return an untrained network."""
        return AttentionGains(
            self._features(case),
            gain_scale=gain_scale(case.gains),
            shape=replace(case.config.shape, spatial_damping=damping == PER_CONTACT),
            generator=torch.Generator().manual_seed(case.config.seed),
        )

    def rows(self, case: GainCase) -> Int[Tensor, " contacts"]:
        """Return the points nearest to the contacts."""
        return self._features(case).nearest(case.train.contacts)

    def _features(self, case: GainCase) -> FeatureField:
        return case.features if self.features is None else self.features


def fingerprint(case: GainCase, recipe: GainRecipe) -> str:
    """Return a digest of all that decides a fit's result, this package's version and code among it."""
    train, modes = case.train, case.modes
    words = [version("avmsf"), source_digest("avmsf.field.fit"), asdict(case.config), recipe.name, recipe.digest()]
    words += [train.digest(), case.features.digest()]
    digest = hashlib.sha256(json.dumps(words, sort_keys=True).encode())
    tensors = [modes.bank.frequency, modes.bank.damping, modes.residual.magnitude]
    # Phases, and without a warm-up how strong the modes are, are those of the extraction.
    for tensor in (*tensors, modes.gains, modes.quadrature):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _expect_fitting(train: Impacts, modes: Extraction) -> None:
    if len(train) == 0:
        raise FitError("train: expected 1 recording or more, got none; record impacts", name="train", value=0)
    for row, (name, sound, contact) in enumerate(zip(train.names, train.sounds, train.contacts, strict=True)):
        if not bool(torch.isfinite(sound).all() and torch.isfinite(contact).all()):
            raise FitError(
                f"{name}: expected finite samples and coordinates, got NaN or infinity; remove the recording",
                name=name,
                row=row,
            )
    if train.directions is not None and not bool(torch.isfinite(train.directions).all()):
        row = int(torch.nonzero(~torch.isfinite(train.directions).all(1))[0])
        direction = train.directions[row].tolist()
        raise FitError(
            f"{train.names[row]}: expected a finite direction, got {direction}; give the direction in which the hammer "
            "moves, or zeros if unknown",
            name=train.names[row],
            row=row,
            value=direction,
        )
    if float(train.sounds.abs().max()) == 0.0:
        raise FitError(
            "train: expected sound, got silence in all recordings; check the channel", name="train", value="silence"
        )
    advice = "extract the modes from the recordings that the field is fitted to"
    if len(modes.gains) != len(train):
        raise FitError.expected(f"gains of {len(train)} recordings", len(modes.gains), name="modes", advice=advice)
    if len(modes.bank) == 0:
        raise FitError("modes: expected 1 mode or more, got none; record longer or louder", name="modes", value=0)
    highest, limit = float(modes.bank.frequency.max()), train.sample_rate / 2
    if highest >= limit:
        raise FitError(
            f"modes: expected frequencies below {limit:g} Hz, got {highest:g} Hz; {advice}", name="modes", value=highest
        )
