"""A small plate to open: its field, its capture, recordings of it."""

import io
from functools import cache
from pathlib import Path

import numpy as np
import soundfile
import torch

from avmsf.field.sound_field import Origin, SoundField
from avmsf.field.store import save
from avmsf.modal.residual_noise import Residual
from avmsf.studio.opening import Opened
from factories.capture_folder import ring
from factories.made_fields import BANK, FIELDS

RATE = 8000


def plate_field(kind: str = "positional") -> SoundField:
    phase = torch.zeros(len(BANK), dtype=torch.float64)
    return SoundField(BANK, FIELDS[kind](), phase, Residual(torch.full((9,), 1e-6)), float(RATE), 2400, Origin("plate"))


def open_plate(home: Path, kind: str = "positional") -> Opened:
    home.mkdir(parents=True, exist_ok=True)
    path = home / "plate.safetensors"
    save(plate_field(kind), path)
    return Opened("plate", home, field=path)


def wav(samples: np.ndarray, *, rate: int = RATE, subtype: str = "FLOAT", kind: str = "WAV") -> bytes:
    memory = io.BytesIO()
    soundfile.write(memory, samples, rate, subtype=subtype, format=kind)
    return memory.getvalue()


@cache
def blow(seed: int = 0, **options: float) -> bytes:
    """Return a wav file; the same object again, for its header holds the time at which it was written."""
    return wav(ring(before=0.1, seed=seed, **options))
