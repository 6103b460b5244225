from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation

from avmsf.gaussians.cloud import GaussianCloud, rotation_matrices
from avmsf.gaussians.config import SplatConfig
from avmsf.gaussians.densify import Density
from factories.clouds import random_cloud

CONFIG = SplatConfig(growth=1.0, large=0.01, least_opacity=0.1, gaussians=10_000)
HALF_DIAGONAL = 1.0


def _cloud(scales: list[float], opacities: list[float]) -> GaussianCloud:
    log_scales = torch.tensor(scales).log()[:, None].repeat(1, 3)
    return replace(
        random_cloud(len(scales), degree=1), log_scales=log_scales, logit_opacities=torch.tensor(opacities).logit()
    )


def _densified(cloud: GaussianCloud, gradient: list[float], config: SplatConfig) -> tuple[torch.Tensor, GaussianCloud]:
    # Seen twice each: the mean counts.
    density = Density(2 * torch.tensor(gradient), torch.full((len(cloud),), 2.0))
    return density.densify(cloud, config, HALF_DIAGONAL, generator=torch.Generator().manual_seed(3))


def test_small_ones_are_copied_large_ones_split_and_faint_ones_go() -> None:
    cloud = _cloud([0.005, 0.005, 0.05, 0.05, 0.005, 0.9], [0.5, 0.5, 0.5, 0.5, 0.05, 0.5])
    rows, fresh = _densified(cloud, [2.0, 0.5, 3.0, 0.5, 9.0, 9.0], CONFIG)
    # 0 is copied and stays, 2 gives way to its halves, 4 is faint and 5 as large as the object: neither is doubled.
    assert rows.tolist() == [0, 1, 3]
    assert len(fresh) == 3
    for name in ("centers", "rotations", "log_scales", "logit_opacities", "harmonics"):
        assert torch.equal(getattr(fresh, name)[0], getattr(cloud, name)[0])
    torch.testing.assert_close(fresh.log_scales[1:].exp(), torch.full((2, 3), 0.05 / 1.6))


def test_halves_are_drawn_from_the_gaussian_that_they_replace() -> None:
    count = 4000
    scales = torch.tensor([0.2, 0.05, 0.02])
    turned = torch.tensor([0.9, 0.1, -0.3, 0.2])
    cloud = _cloud([0.2], [0.5])
    cloud = replace(cloud, rotations=turned[None], log_scales=scales.log()[None]).take(torch.zeros(count).long())
    _, fresh = _densified(cloud, [2.0] * count, CONFIG)
    offsets = (fresh.centers - cloud.centers[0]).double()
    rotation = torch.from_numpy(Rotation.from_quat(turned.tolist(), scalar_first=True).as_matrix())
    expected = rotation @ torch.diag(scales.double() ** 2) @ rotation.T
    # A covariance of 8000 draws is within sqrt(2 / 8000) = 1.6 %; four of these of the largest.
    torch.testing.assert_close(torch.cov(offsets.T), expected, rtol=0, atol=0.064 * 0.2**2)


def test_the_strongest_come_first_when_room_is_short() -> None:
    cloud = _cloud([0.005] * 5, [0.5] * 5)
    rows, fresh = _densified(cloud, [2.0, 5.0, 3.0, 4.0, 0.1], replace(CONFIG, gaussians=100))
    assert len(fresh) == 4
    _, fresh = _densified(
        cloud.take(torch.arange(100) % 5), [2.0, 5.0, 3.0, 4.0, 0.1] * 20, replace(CONFIG, gaussians=103)
    )
    assert torch.equal(fresh.centers, cloud.centers[[1, 1, 1]])
    assert rows.tolist() == [0, 1, 2, 3, 4]


def test_quaternions_turn_as_scipy_turns() -> None:
    quaternions = torch.randn(50, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = Rotation.from_quat(quaternions.numpy(), scalar_first=True).as_matrix()
    torch.testing.assert_close(rotation_matrices(quaternions), torch.from_numpy(expected))
