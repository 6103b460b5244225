"""The small plate as a capture folder, and the options that fit a field to it in a moment."""

from dataclasses import replace
from pathlib import Path

import torch

from avmsf.capture import Capture, write_capture
from avmsf.mesh import Surface
from factories.settings import sets
from oracles.plate import Plate, sample_contacts, strike

RATE, HIGHEST, CONTACT_TIME = 8000.0, 2500.0, 5e-4
PLATE = Plate(alpha=40.0)
"""Damped, so that half a second is enough for it to die away."""

TINY = (
    *sets("fit.clusters=8 fit.width=16 fit.hidden=32 fit.layers=1 fit.fft_sizes=1024,256 fit.warmup_steps=12"),
    *sets("fit.steps=6 fit.early=1024 fit.damping=shared"),
    *("--modes", "12"),
)


def fill_plate(folder: Path, *, surface: bool = True, rate: float = RATE) -> Path:
    a, b = PLATE.length, PLATE.width
    corners = torch.tensor([[0.0, 0.0, 0.0], [a, 0.0, 0.0], [a, b, 0.0], [0.0, b, 0.0]])
    shape = Surface(corners, torch.tensor([[0, 1, 2], [0, 2, 3]])) if surface else None
    generator = torch.Generator().manual_seed(0)
    impacts = strike(
        PLATE,
        sample_contacts(PLATE, 8, generator=generator),
        sample_rate=RATE,
        seconds=0.5,
        generator=generator,
        noise_db=-40.0,
        highest=HIGHEST,
        contact_time=CONTACT_TIME,
    )
    impacts = replace(impacts, sample_rate=rate)
    write_capture(Capture("plate", impacts, shape), folder)
    return folder
