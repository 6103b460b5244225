"""How like two images are: SSIM, as a figure and as a loss with its gradient, and PSNR.

SSIM (Wang et al. 2004) compares means, variances and covariance under a Gaussian window of 11 x 11 pixels and a
standard deviation of 1.5, channel by channel, and takes the mean over all pixels. As in 3DGS, outside of the images
there is zero.
"""

import math
from typing import Any, cast, no_type_check

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avmsf.compiled import compiled
from avmsf.scene.tiles import KERNELS

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
        return _plain_similarity(image, target.detach())
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


def _plain_similarity(image: Tensor, target: Tensor) -> Tensor:
    """Return the same by convolutions, which graphics cards do best."""
    window = torch.from_numpy(np.outer(_WINDOW, _WINDOW)).to(image)
    maps = torch.stack([image, target, image * image, target * target, image * target]).permute(0, 3, 1, 2)
    kernel = window.expand(3, 1, *window.shape)
    x, y, xx, yy, xy = torch.nn.functional.conv2d(maps, kernel, padding=_REACH, groups=3)
    likeness = (2 * x * y + _C1) / (x * x + y * y + _C1)
    return (likeness * (2 * (xy - x * y) + _C2) / (xx - x * x + yy - y * y + _C2)).mean()


class _Similarity(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, image: Tensor, target: Tensor) -> Tensor:
        height, width = image.shape[:2]
        # Channels lie side by side in a row, so that one run over memory filters all three.
        first = image.detach().cpu().contiguous().numpy().reshape(height, 3 * width)
        second = target.cpu().contiguous().numpy().reshape(height, 3 * width)
        across = np.empty((5, height, 3 * width), dtype=first.dtype)
        similar = np.empty(height)
        slopes = np.empty((3, height, 3 * width), dtype=first.dtype)
        window = _WINDOW.astype(first.dtype)
        gradient = np.empty_like(first)
        with KERNELS:
            _filter_products(first, second, window, across)
            _compare(across, window, similar, slopes)
            if context.needs_input_grad[0]:
                _filter_slopes(first, second, slopes, window, across[:3], gradient)
        if context.needs_input_grad[0]:
            context.save_for_backward(torch.from_numpy(gradient).reshape(image.shape).to(image.device))
        return image.new_tensor(similar.sum() / image.numel())

    @staticmethod
    def backward(context: Any, *gradients: Any) -> tuple[Tensor | None, None]:
        (slope,) = context.saved_tensors
        return gradients[0] * slope, None


@compiled(fastmath=True, parallel=True)
@no_type_check
def _filter_products(first, second, window, across):
    """Filter both images, their squares and their product along the rows."""
    height, length = first.shape
    edge = 3 * _REACH
    for row in numba.prange(height):
        padded = np.zeros((5, length + 2 * edge), first.dtype)
        for place in range(length):
            one, other = first[row, place], second[row, place]
            padded[0, place + edge] = one
            padded[1, place + edge] = other
            padded[2, place + edge] = one * one
            padded[3, place + edge] = other * other
            padded[4, place + edge] = one * other
        for which in range(5):
            _filter_row(padded[which], window, across[which, row])


@compiled(fastmath=True, parallel=True)
@no_type_check
def _compare(across, window, similar, slopes):
    """Filter along the columns; sum each row's SSIM and note its slopes by mean, square and product."""
    height, length = across.shape[1:]
    kind = across.dtype.type
    c1, c2, one, two = kind(_C1), kind(_C2), kind(1), kind(2)
    share = kind(1.0 / (height * length))
    for row in numba.prange(height):
        means = np.zeros((5, length), across.dtype)
        for which in range(5):
            _filter_column(across[which], window, row, means[which])
        total = 0.0
        for place in range(length):
            x, y = means[0, place], means[1, place]
            variances = means[2, place] - x * x + means[3, place] - y * y
            covariance = means[4, place] - x * y
            likeness, spread = two * x * y + c1, two * covariance + c2
            inverse_squares, inverse_variances = one / (x * x + y * y + c1), one / (variances + c2)
            value = likeness * spread * inverse_squares * inverse_variances
            total += value
            by_square = -value * inverse_variances
            by_product = two * likeness * inverse_squares * inverse_variances
            by_mean = two * (y * spread * inverse_squares * inverse_variances - x * value * inverse_squares)
            # Variance and covariance hold the mean too.
            slopes[0, row, place] = share * (by_mean - two * x * by_square - y * by_product)
            slopes[1, row, place] = share * by_square
            slopes[2, row, place] = share * by_product
        similar[row] = total


@compiled(fastmath=True, parallel=True)
@no_type_check
def _filter_slopes(first, second, slopes, window, across, gradient):
    """Take the slopes back through the filter, which is its own transpose, to the first image."""
    height, length = first.shape
    edge = 3 * _REACH
    for row in numba.prange(height):
        padded = np.zeros(length + 2 * edge, first.dtype)
        for which in range(3):
            padded[edge : edge + length] = slopes[which, row]
            _filter_row(padded, window, across[which, row])
    two = first.dtype.type(2)
    for row in numba.prange(height):
        back = np.zeros((3, length), first.dtype)
        for which in range(3):
            _filter_column(across[which], window, row, back[which])
        for place in range(length):
            gradient[row, place] = (
                back[0, place] + two * first[row, place] * back[1, place] + second[row, place] * back[2, place]
            )


@compiled(fastmath=True)
@no_type_check
def _filter_row(padded, window, out):
    w0, w1, w2, w3, w4, w5 = window[0], window[1], window[2], window[3], window[4], window[5]
    for place in range(len(out)):
        out[place] = (
            w0 * (padded[place] + padded[place + 30])
            + w1 * (padded[place + 3] + padded[place + 27])
            + w2 * (padded[place + 6] + padded[place + 24])
            + w3 * (padded[place + 9] + padded[place + 21])
            + w4 * (padded[place + 12] + padded[place + 18])
            + w5 * padded[place + 15]
        )


@compiled(fastmath=True)
@no_type_check
def _filter_column(across, window, row, out):
    """Add up the rows under the window around `row`, as far as there are any, in `out`."""
    height, length = across.shape
    for tap in range(2 * _REACH + 1):
        at = row + tap - _REACH
        if 0 <= at < height:
            weight = window[tap]
            for place in range(length):
                out[place] += weight * across[at, place]
