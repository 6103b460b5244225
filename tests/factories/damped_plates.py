"""Plates of wood and plastic, whose broad modes fill their band, and fields that know them exactly."""

from functools import cache

import torch
from torch import Tensor

from avmsf.field.sound_field import Origin, SoundField
from avmsf.localization.locator import Locator
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import Residual
from factories.located_plate import TrueGains
from oracles.plate import Plate, plate_modes, plate_surface_points, sample_contacts, strike

RATE, SECONDS, LENGTH = 44100.0, 0.4, 0.24
HIGHEST = {"wood": 6000.0, "plastic": 3000.0}


def plate(material: str, length: float = LENGTH) -> Plate:
    sizes = {"length": length, "width": length / 1.44, "thickness": 0.003}
    if material == "wood":
        return Plate(**sizes, young=1.1e10, density=750.0, poisson=0.25, alpha=60.0, beta=2e-6)
    return Plate(**sizes, young=1.4e9, density=1070.0, poisson=0.35, alpha=30.0, beta=1e-6)


@cache
def damped_field(material: str) -> SoundField:
    own = plate(material)
    modes = plate_modes(own, plate_surface_points(own, 1), highest=HIGHEST[material])
    return SoundField(
        ModalBank(modes.frequency, modes.damping),
        TrueGains(plate_surface_points(own, 400).float(), plate=own, highest=HIGHEST[material]),
        torch.zeros(len(modes.frequency), dtype=torch.float64),
        Residual(torch.full((65,), 1e-3)),
        RATE,
        round(RATE * SECONDS),
        Origin(),
    )


@cache
def damped_locator(material: str) -> Locator:
    return Locator.of(damped_field(material))


def damped_blows(material: str, *, length: float = LENGTH, heard_by: str, noise_db: float = -40.0) -> Tensor:
    """Return eight blows on a plate, up to the highest frequency that the field of material `heard_by` knows."""
    generator = torch.Generator().manual_seed(0)
    struck = plate(material, length)
    contacts = sample_contacts(struck, 8, generator=generator)
    return strike(
        struck,
        contacts,
        sample_rate=RATE,
        seconds=SECONDS,
        generator=generator,
        noise_db=noise_db,
        highest=HIGHEST[heard_by],
    ).sounds
