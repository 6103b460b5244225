"""A simulated plate, its fields and their locators, and how far off its contacts are located."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch

from avmsf.capture.impacts import Impacts
from avmsf.field.gains.kernels import Sites
from avmsf.field.gains.mixture_gains import MixtureGains
from avmsf.field.gains.model import Gains
from avmsf.field.sound_field import Origin, SoundField
from avmsf.localization.contact_map import ContactPosterior
from avmsf.localization.locator import Locator
from avmsf.modal.extraction.least_squares import fit_gains
from avmsf.modal.modes import ModalBank
from factories.made_fields import StandIn, mixture, sounding
from oracles.plate import Plate, plate_modes, plate_surface_points, strike

PLATE = Plate()
RATE, SECONDS, HIGHEST = 18000.0, 0.4, 8000.0
DIAGONAL = math.hypot(PLATE.length, PLATE.width)


@dataclass(frozen=True, eq=False)
class TrueGains(StandIn):
    """The plate's own gains, in closed form."""

    points: torch.Tensor
    turned: bool = False
    factor: float | None = None
    plate: Plate = PLATE
    highest: float = HIGHEST

    def predict(self, points: torch.Tensor, directions: torch.Tensor | None = None) -> Gains:
        gains = plate_modes(self.plate, points, highest=self.highest).gains.float()
        shape = gains.shape
        damping = None if self.factor is None else 1.0 + self.factor * torch.linspace(0, 1, shape[1]).expand(shape)
        return Gains(gains + 0.4j * gains.roll(1, 1) if self.turned else gains, damping=damping)


@cache
def bank() -> ModalBank:
    modes = plate_modes(PLATE, plate_surface_points(PLATE, 1), highest=HIGHEST)
    return ModalBank(modes.frequency, modes.damping)


def field_of(gains: object, *, phase: float = 0.0) -> SoundField:
    samples = round(RATE * SECONDS)
    return sounding(gains, bank=bank(), phase=phase, noise=1e-3, rate=RATE, samples=samples, origin=Origin())


@cache
def true_field(points: int = 1500) -> SoundField:
    return field_of(TrueGains(plate_surface_points(PLATE, points).float()))


@cache
def locator_of(taps: int | None = None) -> Locator:
    """Return a locator, of true gains without `taps`."""
    if taps is None:
        return Locator.of(true_field())
    impacts = struck(taps, seed=5)
    values = fit_gains(impacts.sounds, bank(), sample_rate=RATE).to(torch.complex128)
    return Locator.of(
        field_of(mixture_of(impacts.contacts, values, bank=bank(), points=plate_surface_points(PLATE, 1500)))
    )


def struck(count: int, *, seed: int, noise_db: float = -40.0, plate: Plate = PLATE) -> Impacts:
    return strike(plate, count, sample_rate=RATE, seconds=SECONDS, seed=seed, noise_db=noise_db, highest=HIGHEST)


def mixture_of(contacts: torch.Tensor, values: torch.Tensor, **about: Any) -> MixtureGains:
    """Return gains fitted to those measured at contacts of the plate, or of another object, struck from above."""
    sites = Sites(contacts, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(contacts))
    return mixture(sites, values, directional=False, variance=0.0, **{"size": DIAGONAL, **about})


def mirrored(contact: torch.Tensor) -> torch.Tensor:
    """Return the contact and its images in the plate's two planes of symmetry, which sound the same."""
    x, y, z = contact.tolist()
    return torch.tensor([[a, b, z] for a in (x, PLATE.length - x) for b in (y, PLATE.width - y)])


def missed(found: ContactPosterior, row: int, contact: torch.Tensor) -> float:
    """Return how far a row is from the contact or an image, over the diagonal."""
    return float((mirrored(contact) - found.points[row]).norm(dim=1).min()) / DIAGONAL


def held(found: ContactPosterior, contact: torch.Tensor) -> bool:
    nearest = torch.cdist(mirrored(contact), found.points).argmin(1)
    return bool(found.region(0.9)[nearest].any())
