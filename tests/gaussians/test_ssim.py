import math

import numpy as np
import pytest
import torch

from avmsf.gaussians.ssim import convolved_ssim, psnr, ssim


def _images(height: int = 13, width: int = 17) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    first = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return first, (first + 0.3 * torch.rand(height, width, 3, generator=generator, dtype=torch.float64)) / 1.3


def test_similarity_is_wangs_formula_window_by_window() -> None:
    first, second = (each.numpy() for each in _images())
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    values = []
    for channel in range(3):
        one, other = (np.pad(each[..., channel], 5) for each in (first, second))
        for row, column in np.ndindex(first.shape[:2]):
            x, y = one[row : row + 11, column : column + 11], other[row : row + 11, column : column + 11]
            mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
            # Variances about the mean, not as differences of moments.
            var_x, var_y = (weights * (x - mean_x) ** 2).sum(), (weights * (y - mean_y) ** 2).sum()
            covariance = (weights * (x - mean_x) * (y - mean_y)).sum()
            values.append(
                (2 * mean_x * mean_y + 0.01**2)
                * (2 * covariance + 0.03**2)
                / ((mean_x**2 + mean_y**2 + 0.01**2) * (var_x + var_y + 0.03**2))
            )
    # Both in float64: what is left is rounding.
    assert float(ssim(*map(torch.from_numpy, (first, second)))) == pytest.approx(np.mean(values), abs=1e-12)


def test_the_gradient_is_that_of_finite_differences() -> None:
    first, second = _images(7, 8)
    # gradcheck's own tolerances for float64: 1e-5 absolute, 1e-3 relative.
    assert torch.autograd.gradcheck(lambda image: ssim(image, second), first.requires_grad_())


def test_graphics_cards_get_the_same_value_and_gradient() -> None:
    first, second = _images()
    one, other = first.clone().requires_grad_(), first.clone().requires_grad_()
    value, plain = ssim(one, second), convolved_ssim(other, second)
    (2.0 * value).backward()
    (2.0 * plain).backward()
    assert float(value.detach()) == pytest.approx(float(plain.detach()), abs=1e-12)
    torch.testing.assert_close(one.grad, other.grad, rtol=0, atol=1e-12)


def test_psnr_of_a_tenth_is_twenty_decibels() -> None:
    target = torch.full((4, 6, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    inside = torch.zeros(4, 6, dtype=torch.bool)
    inside[:2] = True
    image = target + torch.where(inside, 0.1, 0.4)[..., None]
    assert psnr(image, target, inside=inside) == pytest.approx(20.0, abs=1e-4)
    assert psnr(target, target) == math.inf
    # A screen shows 1.3 as 1.
    assert psnr(torch.full((4, 6, 3), 1.3), torch.full((4, 6, 3), 0.9)) == pytest.approx(20.0, abs=1e-4)
