"""Random Gaussians."""

import torch

from avmsf.gaussians.cloud import GaussianCloud


def random_cloud(points: torch.Tensor | int, *, degree: int = 0, seed: int = 0) -> GaussianCloud:
    """Return Gaussians at given points, or so many at random ones, with shapes, opacities and colors of chance."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    centers = draw(points, 3) if isinstance(points, int) else points
    count = len(centers)
    return GaussianCloud(centers, draw(count, 4), draw(count, 3), draw(count), draw(count, (degree + 1) ** 2, 3))
