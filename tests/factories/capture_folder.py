"""Capture folders that the tests fill by hand, as a user would."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import soundfile

RATE = 8000
HEADER = "file,x,y,z"
ROWS = ("a.wav,0.1,0,0", "b.wav,0,0.2,0", "c.wav,0,0,0.3")


def ring(
    seconds: float = 0.5, *, rate: int = RATE, before: float = 0.0, noise: float = 1e-4, seed: int = 0
) -> np.ndarray:
    """Return five modes that set in after `before` seconds, with a peak of about a half, in white noise."""
    generator = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate - before
    frequencies = np.array([0.05, 0.09, 0.13, 0.2, 0.31]) * rate
    gains = generator.uniform(0.5, 1, 5) * np.array([1, -1, 1, 1, -1])
    modes = np.exp(-20 * np.maximum(time, 0)[:, None]) * np.sin(2 * np.pi * frequencies * time[:, None])
    return 0.15 * np.where(time >= 0, modes @ gains, 0) + noise * generator.standard_normal(len(time))


def fill(
    folder: Path,
    *,
    sounds: dict[str, np.ndarray] | None = None,
    rows: Sequence[str] = ROWS,
    header: str = HEADER,
    settings: str | None = None,
    replace: dict[str, np.ndarray | bytes | None] | None = None,
    rate: int = RATE,
    subtype: str = "FLOAT",
) -> Path:
    """Write a folder of three good recordings; `replace` gives others, shape [frames] or [frames, channels].

    Bytes are written as they are, and None leaves a file out. With `sounds`, these are all, at contacts in a row.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if sounds is not None:
        rows = [f"{name},{row / 10},0,0" for row, name in enumerate(sounds)]
    else:
        sounds = {name: ring(rate=rate, seed=seed) for seed, name in enumerate(("a.wav", "b.wav", "c.wav"))}
    (folder / "impacts.csv").write_bytes("\n".join([header, *rows, ""]).encode())
    if settings is not None:
        (folder / "capture.toml").write_text(settings)
    for name, samples in (sounds | (replace or {})).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        if isinstance(samples, bytes):
            (folder / name).write_bytes(samples)
        elif samples is not None:
            soundfile.write(folder / name, samples, rate, subtype=subtype)
    return folder
