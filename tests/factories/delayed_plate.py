"""Strikes on a plate in closed form, read at starts that are off by known fractions of samples."""

import math

import torch
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.modal.extraction.extract import Extraction

RATE, SAMPLES, LEAD = 8000.0, 2000, 160
ALIGNED = 0.02
"""Relative error of a sound that is aligned: sines that start suddenly are not limited to half the rate."""
FREQUENCY = torch.tensor([331.0, 502.5, 770.0, 1004.0, 1317.0], dtype=torch.float64)
DAMPING = torch.tensor([18.0, 22.0, 25.0, 30.0, 40.0], dtype=torch.float64)
PHASE = torch.tensor([0.1, -0.1, 0.2, 0.0, 0.1], dtype=torch.float64)
NUMBERS = torch.tensor([[1, 0], [0, 1], [1, 1], [2, 0], [2, 1]], dtype=torch.float64)
"""Half waves of each mode along the two sides of the unit square."""


def delays(count: int) -> Tensor:
    """Return delays of one to three samples, of either sign, none a whole number."""
    generator = torch.Generator().manual_seed(5)
    size = 1 + 2 * torch.rand(count, dtype=torch.float64, generator=generator)
    return size * torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(count)[:count]


def strikes(count: int, *, starts: Tensor | None = None) -> Impacts:
    """Return recordings of impacts `starts` samples after sample 0 of `sounds`; without them all are at sample 0."""
    generator = torch.Generator().manual_seed(5)
    contacts = torch.cat([torch.rand(count, 2, dtype=torch.float64, generator=generator), torch.zeros(count, 1)], 1)
    gains = torch.cos(math.pi * contacts[:, None, :2] * NUMBERS).prod(2)
    after = torch.arange(-LEAD, SAMPLES + LEAD, dtype=torch.float64) - (0 if starts is None else starts[:, None])
    times = (after / RATE).expand(count, -1)[:, None]
    angles = 2 * math.pi * FREQUENCY[:, None] * times + PHASE[:, None]
    waves = torch.exp(-DAMPING[:, None] * times.clamp(min=0)) * angles.sin() * (times >= 0)
    files = (gains[:, :, None] * waves).sum(1)
    files += 1e-4 * torch.randn(files.shape, dtype=torch.float64, generator=generator)
    return cut(files, rate=RATE, lead=LEAD, samples=SAMPLES, contacts=contacts)


def cut(files: Tensor, *, rate: float, lead: int, samples: int, contacts: Tensor | None = None) -> Impacts:
    """Return recordings whose sounds start after `lead` samples of their files."""
    contacts = torch.zeros(len(files), 3) if contacts is None else contacts
    before, sounds, after = (part.contiguous() for part in files.float().tensor_split((lead, lead + samples), dim=1))
    names = tuple(f"{row:02d}.wav" for row in range(len(files)))
    return Impacts(contacts, sounds, rate, names, before=before, after=after)


def without_delays(impacts: Impacts, modes: Extraction, starts: Tensor) -> Impacts:
    """Return delayed recordings as they were before, but for what their alignment moved all of them by."""
    assert modes.alignment is not None
    names = strikes(len(starts)).names
    aligned, asked = ([names.index(name) for name in each.names] for each in (modes.alignment, impacts))
    common = (modes.alignment.delays - starts[aligned]).median()
    return strikes(len(starts)).delayed(common.expand(len(starts))).take(asked)


def distance(found: Tensor, expected: Tensor) -> float:
    """Return the largest relative error of a row."""
    return float(((found - expected).norm(dim=1) / expected.norm(dim=1)).max())
