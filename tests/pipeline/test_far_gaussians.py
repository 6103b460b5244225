"""Gaussians far from an object, as floaters and the background are, do not set its size."""

import torch

from avmsf.gaussians.cloud import GaussianCloud
from avmsf.pipeline.scene import without_far


def cloud_of(centers: torch.Tensor) -> GaussianCloud:
    count = len(centers)
    return GaussianCloud(
        centers,
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count, 3), -6.0),
        torch.full((count,), 4.0),
        torch.zeros(count, 1, 3),
    )


def test_gaussians_meters_away_are_left_out_and_a_long_thin_object_is_kept_whole() -> None:
    generator = torch.Generator().manual_seed(0)
    rod = torch.rand(3000, 3, generator=generator) * torch.tensor([0.4, 0.01, 0.01])
    far = 3 * torch.randn(90, 3, generator=generator)
    kept = without_far(cloud_of(torch.cat([rod, far])))
    assert torch.equal(kept.centers, rod)
    assert len(without_far(cloud_of(rod))) == 3000
