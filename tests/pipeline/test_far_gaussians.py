"""Gaussians far from an object, as floaters and the background are, do not set its size."""

import torch

from avmsf.pipeline.scene import without_far
from factories.clouds import random_cloud


def test_gaussians_meters_away_are_left_out_and_a_long_thin_object_is_kept_whole() -> None:
    generator = torch.Generator().manual_seed(0)
    rod = torch.rand(3000, 3, generator=generator) * torch.tensor([0.4, 0.01, 0.01])
    far = 3 * torch.randn(90, 3, generator=generator)
    kept = without_far(random_cloud(torch.cat([rod, far])))
    assert torch.equal(kept.centers, rod)
    assert len(without_far(random_cloud(rod))) == 3000
