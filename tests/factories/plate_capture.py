"""The small plate as a capture folder, and the options that fit a field to it in a moment."""

from dataclasses import replace
from pathlib import Path

from avmsf.capture import Capture, write_capture
from factories.plate_field import RATE, plate_impacts, rectangle
from factories.verbs import sets
from oracles.plate import Plate

PLATE = Plate(alpha=40.0)
"""Damped, so that half a second is enough for it to die away."""

TINY = (
    *sets("fit.clusters=8 fit.width=16 fit.hidden=32 fit.layers=1 fit.fft_sizes=1024,256 fit.warmup_steps=12"),
    *sets("fit.steps=6 fit.early=1024 fit.damping=shared modes=12"),
)


def fill_plate(folder: Path, *, surface: bool = True, rate: float = RATE) -> Path:
    impacts = replace(plate_impacts(8, seconds=0.5, plate=PLATE), sample_rate=rate)
    write_capture(Capture("plate", impacts, rectangle(PLATE) if surface else None), folder)
    return folder
