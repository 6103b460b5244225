"""Random Gaussians, and recordings of made-up objects."""

from functools import partial

import torch

from avmsf.capture.impacts import Impacts
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.modal.modes import synthesize

SECONDS = 0.5


def random_cloud(points: torch.Tensor | int, *, degree: int = 0) -> GaussianCloud:
    """Return Gaussians at given points, or so many at random ones, with shapes, opacities and colors of chance."""
    draw = partial(torch.randn, generator=torch.Generator().manual_seed(0))
    centers = draw(points, 3) if isinstance(points, int) else points
    count = len(centers)
    return GaussianCloud(centers, draw(count, 4), draw(count, 3), draw(count), draw(count, (degree + 1) ** 2, 3))


def cloud(count: int = 60, *, degree: int = 1, seed: int = 0) -> GaussianCloud:
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(count, 3, generator=generator) * torch.tensor([0.2, 0.1, 0.05]) - 0.3
    return GaussianCloud(
        centers,
        torch.randn(count, 4, generator=generator),
        torch.randn(count, 3, generator=generator) - 6.0,
        torch.rand(count, generator=generator) + 0.1,
        torch.randn(count, (degree + 1) ** 2, 3, generator=generator),
    )


def impacts(count: int = 6, *, seed: int = 0) -> Impacts:
    generator = torch.Generator().manual_seed(seed)
    contacts = cloud(count, seed=seed).centers.double()
    frequency = torch.tensor([700.0, 1900.0, 4100.0], dtype=torch.float64) * (1.0 + 0.1 * seed)
    gains = torch.cos(40.0 * contacts)
    noise = 1e-3 * torch.randn(count, round(SECONDS * 24000), generator=generator)
    sounds = synthesize(gains.float(), frequency, 8.0 + 1e-3 * frequency, samples=noise.shape[1], sample_rate=24_000.0)
    return Impacts(contacts, sounds + noise, 24_000.0, tuple(f"{row}.wav" for row in range(count)))
