"""How like two images are: SSIM, as a figure and as a loss with its gradient, and PSNR.

SSIM (Wang et al. 2004) compares means, variances and covariance under a Gaussian window of 11 x 11 pixels and a
standard deviation of 1.5, channel by channel, and takes the mean over all pixels. As in 3DGS, outside of the images
there is zero.
"""

import math
from typing import Any, cast, no_type_check

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avmsf._utils.compiled import compiled

_REACH = 5
"""Pixels from the window's middle to its end."""
_WINDOW = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / 1.5) ** 2)
_WINDOW /= _WINDOW.sum()
_C1, _C2 = 0.01**2, 0.03**2
"""What keeps the quotients finite, for values from 0 to 1."""


def ssim(image: Float[Tensor, "height width 3"], target: Float[Tensor, "height width 3"]) -> Float[Tensor, ""]:
    """Return the mean structural similarity of two images with values from 0 to 1; 1 for equal ones.

    Differentiable by `image`; on the CPU its gradient is computed on the way, where it is asked for.
    """
    if image.device.type != "cpu":
        return convolved_ssim(image, target.detach())
    return cast(Tensor, _Similarity.apply(image, target.detach()))  # type: ignore[no-untyped-call]


def psnr(
    image: Float[Tensor, "height width 3"],
    target: Float[Tensor, "height width 3"],
    *,
    inside: Bool[Tensor, "height width"] | None = None,
) -> float:
    """Return the peak signal to noise ratio, dB, of an image with values from 0 to 1, over the pixels `inside`.

    Values outside of 0 to 1 count as the end that they are beyond, which is what a screen shows. NaN without a pixel.
    """
    error = (image.detach().clamp(0.0, 1.0).double() - target.double()).square()
    mean = float(error.mean() if inside is None else error[inside].mean())
    return -10.0 * math.log10(mean) if mean > 0.0 else (math.inf if mean == 0.0 else math.nan)


def convolved_ssim(
    image: Float[Tensor, "height width 3"], target: Float[Tensor, "height width 3"]
) -> Float[Tensor, ""]:
    """Return the same as `ssim` by convolutions, which GPUs do best; differentiable by both images."""
    window = torch.from_numpy(np.outer(_WINDOW, _WINDOW)).to(image, non_blocking=True)
    maps = torch.stack([image, target, image * image, target * target, image * target]).permute(0, 3, 1, 2)
    kernel = window.expand(3, 1, *window.shape)
    x, y, xx, yy, xy = torch.nn.functional.conv2d(maps, kernel, padding=_REACH, groups=3)
    likeness = (2 * x * y + _C1) / (x * x + y * y + _C1)
    return (likeness * (2 * (xy - x * y) + _C2) / (xx - x * x + yy - y * y + _C2)).mean()


class _Similarity(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, image: Tensor, target: Tensor) -> Tensor:
        x, y = image.detach().contiguous().numpy(), target.contiguous().numpy()
        # Of a run that diverges the loss says so.
        with np.errstate(over="ignore", invalid="ignore"):
            means = [_filtered(each) for each in (x, y, x * x + y * y, x * y)]
        total = _compare(*(each.reshape(-1) for each in means))
        if context.needs_input_grad[0]:
            # The filter is its own transpose.
            by_mean, by_square, by_product = (_filtered(each) for each in means[:3])
            by_square *= x
            by_square *= 2.0
            by_product *= y
            by_mean += by_square
            by_mean += by_product
            by_mean /= image.numel()
            context.save_for_backward(torch.from_numpy(by_mean))
        return image.new_tensor(total / image.numel())

    @staticmethod
    def backward(context: Any, *gradients: Any) -> tuple[Tensor | None, None]:
        # The saved slope would count as a constant. `once_differentiable` raises only where an outer slope has its own.
        if torch.is_grad_enabled():
            raise NotImplementedError("ssim has first derivatives only on the CPU: expected create_graph=False")
        (slope,) = context.saved_tensors
        return gradients[0] * slope, None


def _filtered(values: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Return the means under the window; outside of the image there is zero."""
    return cv2.sepFilter2D(values, -1, _WINDOW, _WINDOW, borderType=cv2.BORDER_CONSTANT)


@compiled(fastmath={"reassoc", "contract", "nsz"}, error_model="numpy")
@no_type_check
def _compare(first, second, squares, products):
    """Return the sum of the SSIM; write its derivatives over the first three filtered maps.

    The maps hold means of the first image, of the second, of the sum of both squares, and of the product. The
    derivatives are those by the mean of the first image, of its square and of the product.
    """
    kind = first.dtype.type
    c1, c2, one, total = kind(_C1), kind(_C2), kind(1), 0.0
    for place in range(len(first)):
        x, y = first[place], second[place]
        both, product = x * x + y * y, x * y
        variances, covariance = squares[place] - both + c2, products[place] - product
        likeness, spread = product + product + c1, covariance + covariance + c2
        inverse_squares, inverse_variances = one / (both + c1), one / variances
        by_spread = likeness * inverse_squares * inverse_variances
        value = by_spread * spread
        total += value
        by_square, by_product = -value * inverse_variances, by_spread + by_spread
        by_mean = y * spread * inverse_squares * inverse_variances - x * (value * inverse_squares + by_square)
        # Variance and covariance hold the mean too.
        first[place] = by_mean + by_mean - y * by_product
        second[place], squares[place] = by_square, by_product
    return total
