"""Tables of points whose sound is known in full, for the tests of exports."""

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from avmsf.export.sampled_field import SampledField
from avmsf.modal.residual_noise import shape_noise

RATE, SAMPLES, POINTS, MODES = 8000.0, 1600, 9, 4
STRUCK_RATE = 16_000.0
Array = NDArray[np.float64]


def table(
    *,
    phased: bool = False,
    spatial: bool = False,
    noisy: bool = False,
    background_force: float | None = None,
    points: int = POINTS,
    seed: int = 0,
) -> SampledField:
    draw = torch.Generator().manual_seed(seed)
    damping = 8.0 + 30.0 * torch.rand(points, MODES, generator=draw, dtype=torch.float64)
    places = torch.rand(points, 3, generator=draw) - 0.5
    normals = torch.nn.functional.normalize(torch.randn(points, 3, generator=draw), dim=1)
    frequency = torch.tensor([412.3, 1077.7, 1081.25, 3300.1], dtype=torch.float64)
    real = torch.randn(points, MODES, generator=draw)
    gains = torch.complex(real, 0.5 * torch.randn(real.shape, generator=draw) if phased else torch.zeros_like(real))
    noise = torch.randn(SAMPLES, generator=draw) * (0.02 if noisy else 0.0)
    given = (places, normals, frequency, damping if spatial else damping[0], gains, noise, RATE)
    return SampledField(*given, background_force=background_force, name="thing")


def struck_table(*, shared: bool, modes: int = 40, points: int = 6, seconds: float = 3.0) -> SampledField:
    """Return contacts on a ball whose many modes ring between some milliseconds and all of the time."""
    generator = torch.Generator().manual_seed(0)
    drawn = partial(torch.rand, dtype=torch.float64, generator=generator)
    frequency = (60.0 * (0.45 * STRUCK_RATE / 60.0) ** drawn(modes)).sort().values
    damping = 0.5 * 400.0 ** drawn(modes)
    if not shared:
        damping = damping * (0.5 + drawn(points, modes))
    out = torch.nn.functional.normalize(drawn(points, 3) - 0.5, dim=1).float()
    residual, samples = torch.linspace(1e-3, 1e-4, 65), round(seconds * STRUCK_RATE)
    noise = shape_noise(residual, contacts=1, samples=samples, generator=generator)[0]
    size = 0.1 / math.sqrt(modes)
    gains = torch.complex(size * (drawn(points, modes) - 0.5), 0.3 * size * (drawn(points, modes) - 0.5))
    gains = gains.to(torch.complex64)
    return SampledField(0.1 * out, out, frequency, damping, gains, noise, STRUCK_RATE, per_newton=True, name="ball")


def read_arrays(folder: Path, key: str = "arrays") -> dict[str, torch.Tensor]:
    """Return the arrays of a folder by its manifest's offsets, types and shapes, all of one file or each of its own."""
    manifest = json.loads((folder / "manifest.json").read_text())
    found = {}
    for name, record in manifest[key].items():
        content = (folder / (record.get("file") or manifest["file"])).read_bytes()
        values = np.frombuffer(content, record["dtype"], math.prod(record["shape"]), record["offset"])
        found[name] = torch.from_numpy(values.reshape(record["shape"]).copy())
    return found


def summed(gains: Any, frequency: Any, damping: Any, *, samples: int = SAMPLES, rate: float = RATE) -> Array:
    """Return the sum of damped waves, one at a time: an oracle that shares nothing with the package."""
    times = np.arange(samples) / rate
    total = np.zeros(samples)
    for gain, f, d in zip(gains, frequency, damping, strict=True):
        angle = 2 * np.pi * float(f) * times
        total += np.exp(-float(d) * times) * (float(gain.real) * np.sin(angle) + float(gain.imag) * np.cos(angle))
    return total


def apart(heard: Any, true: Any) -> float:
    heard, true = np.asarray(heard, dtype=np.float64), np.asarray(true, dtype=np.float64)
    return float(np.abs(heard - true).max() / np.abs(true).max())
