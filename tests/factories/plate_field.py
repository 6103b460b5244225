"""A small plate, struck and fitted in a moment, for the tests of fields."""

from dataclasses import replace
from typing import Any

import torch

from avmsf.capture.impacts import Impacts
from avmsf.features.feature_field import FeatureField
from avmsf.field.config import FitConfig
from avmsf.field.fit import fit
from avmsf.field.gains.attention import Attention
from avmsf.field.sound_field import SoundField
from avmsf.mesh import Surface
from avmsf.modal.extraction.extract import Extraction
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from oracles.plate import Plate, plate_modes, plate_surface_points, strike

PLATE = Plate()
CONTACT_TIME = 5e-4
HIGHEST = 2500.0
RATE = 8000.0

QUICK = FitConfig(
    clusters=8, width=16, hidden=32, warmup_steps=12, steps=12, fft_sizes=(1024, 256), early=1024, damping="shared"
)


def plate_impacts(
    count: int = 12, *, seconds: float = 0.3, forces: bool = False, plate: Plate = PLATE, seed: int = 0
) -> Impacts:
    excited = {"highest": HIGHEST, "contact_time": CONTACT_TIME}
    impacts = strike(plate, count, sample_rate=RATE, seconds=seconds, seed=seed, noise_db=-40.0, **excited)
    return replace(impacts, forces=torch.full((count,), 2.0)) if forces else impacts


def rectangle(plate: Plate = PLATE) -> Surface:
    """Return the plate's outline as two triangles."""
    a, b = plate.length, plate.width
    corners = torch.tensor([[0.0, 0.0, 0.0], [a, 0.0, 0.0], [a, b, 0.0], [0.0, b, 0.0]])
    return Surface(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def plate_features(count: int = 600) -> FeatureField:
    return FeatureField.from_points(plate_surface_points(PLATE, count))


def plate_extraction(impacts: Impacts) -> Extraction:
    """Return the true modes, a little off as an extraction is, and faint noise."""
    modes = plate_modes(PLATE, impacts.contacts, highest=HIGHEST, contact_time=CONTACT_TIME)
    gains = modes.gains.float()
    level = float(impacts.sounds.square().mean().sqrt()) * 0.01
    bank = ModalBank(modes.frequency + 0.2, modes.damping * 1.05)
    return Extraction(bank, gains + 0j, Residual(torch.full((33,), level)))


def few_impacts() -> dict[str, Any]:
    """Return what a fit to six short recordings is given."""
    impacts = plate_impacts(6, seconds=0.1)
    return {"train": impacts, "features": plate_features(60), "modes": plate_extraction(impacts)}


def plate_fit(config: FitConfig, **changes: Any) -> SoundField:
    """Fit the network to the plate, with other arguments where `changes` names them."""
    train = changes.pop("train", plate_impacts())
    modes = changes.pop("modes", None) or plate_extraction(plate_impacts(len(train)))
    gains = changes.pop("gains", Attention())
    return fit(train, changes.pop("features", plate_features()), modes, config, gains=gains, **changes)


def tensors_of(field: SoundField) -> dict[str, torch.Tensor]:
    """Return all that was fitted, of a field with a network."""
    bank = {"frequency": field.bank.frequency, "damping": field.bank.damping}
    return {**bank, "magnitude": field.residual.magnitude, **field.gain_field.state_dict()}


def same(one: SoundField, other: SoundField) -> bool:
    mine, others = tensors_of(one), tensors_of(other)
    return mine.keys() == others.keys() and all(torch.equal(mine[name], others[name]) for name in mine)
