"""Objects whose materials are known, for the protocol of editing."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import PAPER, FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.estimator import MixtureEstimator
from avmsf.field.sound_field import SoundField
from avmsf.field.trainer import GainEstimator
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank

_CERAMIC = ("3_CeramicKoiBowl", "4_CeramicBowlFish", "9_BowlCeramic", "61_PlanterCeramic", "63_SmallPlanterCeramic",
            "64_CeramicMug", "65_PitcherCeramic")  # fmt: skip
_WOOD = ("27_WoodPlate", "28_WoodPlateSquare", "31_WoodSlab", "32_WoodChalice", "33_WoodWineGlass", "34_WoodMug",
         "68_WoodBoard")  # fmt: skip
_METAL = ("17_IronSkillet", "43_IronMortar", "67_IronPlate", "86_MetalHoledSpoon", "89_MetalSpatula", "90_MetalLadle",
          "91_MetalSpoon")  # fmt: skip
_PLASTIC = ("48_PlasticBowl", "49_PlasticBowl", "50_PlasticBowl", "97_PlasticScoop")
_GLASS = ("94_GlassGoblet",)
_LISTED = {"ceramic": _CERAMIC, "wood": _WOOD, "metal": _METAL, "plastic": _PLASTIC, "glass": _GLASS}
REALIMPACT_26: Mapping[str, str] = {name: material for material, names in _LISTED.items() for name in names}
"""Materials of 26 objects of RealImpact by their names. The paper evaluates on 26 and names none: the choice is ours.

Those whose name contains the material, the first seven of each by number, iron and metal as one, without
self-intersecting meshes. There is one of glass."""

_AUDIBLE_DB = -60.0
"""Energy relative to the strongest mode's, decibels, below which a mode is inaudible."""
DIRECT = FitConfig(steps=0, damping="shared", residual=False)
"""Settings of a field without training end to end and without residual noise, which no edit changes."""
PUBLISHED = replace(PAPER, damping="shared")
"""The paper's field. Its damping is not chosen: the five recordings of an object leave nothing to choose by."""


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object of a known material, its recordings, and its modes."""

    name: str
    material: str
    impacts: Impacts
    modes: Extraction
    """True or extracted, row for row of the impacts."""
    recipe: GainEstimator = field(default_factory=MixtureEstimator)
    """The gain model of its field."""
    features: Callable[[], FeatureField] | None = None
    """Makes the points of its surface with what the gain model reads; the contacts alone where nothing is known."""
    config: FitConfig = DIRECT
    """Settings of its field."""
    checkpoint: Path | None = None
    """File for the state of the field's training."""

    @property
    def bank(self) -> ModalBank:
        """Its audible modes."""
        return audible_modes(self.modes.bank, self.modes.gains.abs())

    @cached_property
    def sound_field(self) -> SoundField:
        """Its field."""
        features = FeatureField.from_points(self.impacts.contacts) if self.features is None else self.features()
        file, modes = self.checkpoint, self.modes
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
        return fit(self.impacts, features, modes, self.config, gains=self.recipe, capture=self.name, checkpoint=file)


def audible_modes(bank: ModalBank, amplitudes: Tensor, *, sample_rate: float = math.inf) -> ModalBank:
    """Return the modes below half the sample rate (Hz) that are within 60 dB of the loudest, in energy.

    `amplitudes` [contacts, modes] are complex or real; a mode's energy is their mean square over 4 d. Raises
    EvaluationError where none is audible.
    """
    energy = amplitudes.abs().double().square().mean(dim=0) / (4.0 * bank.damping)
    energy = torch.where(bank.frequency < 0.5 * sample_rate, energy, 0.0)
    if not bool(energy.max() > 0.0):
        raise EvaluationError.expected("a mode with energy below half the sample rate", len(bank), name="bank")
    kept = energy >= energy.max() * 10.0 ** (_AUDIBLE_DB / 10.0)
    return bank.take(kept)
