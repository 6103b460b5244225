"""A small plate to open: its field, its capture, recordings of it."""

import io
from functools import cache
from pathlib import Path

import numpy as np
import soundfile

from avmsf.field.sound_field import SoundField
from avmsf.field.store import save
from avmsf.studio.opening import Opened
from factories.capture_folder import ring
from factories.made_fields import FIELDS, sounding

RATE = 8000


def plate_field(kind: str = "positional") -> SoundField:
    return sounding(FIELDS[kind](), noise=1e-6, samples=2400)


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
