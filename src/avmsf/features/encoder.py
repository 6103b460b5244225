"""What turns an image into features: one interface for networks, for anyone's own, and for descriptors without any.

A feature map covers its image evenly, whatever its size: cell [row, column] stands for the rectangle that many equal
columns and rows cut out, so that its center lies at ((column + 1/2) width / columns, (row + 1/2) height / rows) pixels.

The descriptors are color, gradient orientation and local shape at several scales, all the same whatever way up the
camera was held. Where g is an image's gradient as a complex number and G a Gaussian, |G * (g^k / |g|^(k-1))| is the
k-th Fourier coefficient, in magnitude, of a dense histogram of gradient orientations in a soft cell: a rotation of the
image turns the coefficient's phase alone. Likewise the eigenvalues of the brightness's second derivatives do not know
which way is up.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Protocol, cast, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from avmsf.errors import SceneError

_Pixels = NDArray[np.float32]


@runtime_checkable
class Encoder(Protocol):
    """Anything that describes what an image shows at each place."""

    @property
    def name(self) -> str:
        """What a feature field keeps, so that its features are never taken for another encoder's."""

    def describe(
        self, image: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"]
    ) -> Float[Tensor, "dim rows columns"]:
        """Return one feature vector a cell of a grid that covers the image evenly.

        The image is red, green and blue as displayed: bytes, or numbers from 0 to 1.
        """


def unit_image(
    image: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"],
) -> Float[Tensor, "height width 3"]:
    """Return an image as float32 numbers from 0 to 1. Raises SceneError for numbers outside of an image's range."""
    color = image.float() / 255 if image.dtype == torch.uint8 else image.float()
    lowest, highest = (float(color.min()), float(color.max())) if color.numel() else (float("nan"),) * 2
    # Renderings overshoot a little; a factor of 255 is a mistake.
    if not -1.0 <= lowest <= highest <= 2.0:
        got = f"{tuple(image.shape)} numbers from {lowest:g} to {highest:g}"
        wanted, advice = "bytes, or numbers from 0 to 1", "divide by the largest value of a pixel"
        raise SceneError.expected(wanted, [lowest, highest], got=got, name="image", advice=advice)
    return color.clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False)
class PatchEncoder(ABC):
    """An encoder by a network that sees square patches."""

    model: nn.Module
    """On whatever device and in whatever precision."""
    name: str
    longest: int | None
    """Pixels of the longer side as it is encoded; None for each image's own."""
    patch: int
    """Pixels of a patch's side."""
    mean: Float[Tensor, "3 1 1"]
    """Mean and standard deviation that the model was trained to have colors normalized with."""
    deviation: Float[Tensor, "3 1 1"]

    @abstractmethod
    def tokens(self, color: Float[Tensor, "1 3 pixel_rows pixel_columns"]) -> Float[Tensor, "dim rows columns"]:
        """Return the network's features of the patches of a normalized image."""

    def describe(
        self, image: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"]
    ) -> Float[Tensor, "dim rows columns"]:
        """Return the patches' features, float32, on a grid that covers the image evenly.

        The image is brought to `longest` pixels on its longer side, normalized, and continued by its last row and
        column to whole patches. Where it ends inside a patch the features are interpolated at the middles of equal
        cells of the image, so that the map covers the image alone.
        """
        color = unit_image(image).permute(2, 0, 1)[None]
        height, width = color.shape[2:]
        if self.longest is not None:
            factor = self.longest / max(height, width)
            height, width = max(1, round(height * factor)), max(1, round(width * factor))
        color = functional.interpolate(color, (height, width), mode="bicubic", align_corners=False, antialias=True)
        color = (color.clamp(0.0, 1.0) - self.mean.to(color)) / self.deviation.to(color)
        rows, columns = -(-height // self.patch), -(-width // self.patch)
        beyond = (0, columns * self.patch - width, 0, rows * self.patch - height)
        color = functional.pad(color, beyond, mode="replicate")
        with torch.no_grad():
            found = self.tokens(color.to(next(self.model.parameters()))).float()
        down, across = height / (rows * self.patch), width / (columns * self.patch)
        inside = found.new_tensor([[[across, 0.0, across - 1.0], [0.0, down, down - 1.0]]])
        cells = functional.affine_grid(inside, [1, *found.shape], align_corners=False)
        found = functional.grid_sample(found[None], cells, padding_mode="border", align_corners=False)[0]
        return found.to(image.device)


def continue_outside(
    color: Float[Tensor, "height width 3"], coverage: Float[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """Return the image with the object's colors carried on smoothly over what lies outside its mask.

    Whatever an encoder then computes near the silhouette speaks of the object: the background, and the edge between
    the two, differ from view to view at one place of the surface. Pixels that the object covers in part go, too, and
    so do those beside them, for masks err by a pixel. An empty mask leaves the image as it is.
    """
    inside = (coverage.cpu().numpy() > 0.99).astype(np.uint8)
    core = cv2.erode(inside, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    weight = core if core.any() else inside
    if not weight.any():
        return color
    filled = _pull_and_push(color.float().cpu().numpy(), weight.astype(np.float32))
    return torch.from_numpy(filled).to(color)


def _pull_and_push(color: _Pixels, weight: _Pixels) -> _Pixels:
    """Fill where the weight is zero from the same image at half its size, which is filled likewise."""
    height, width = weight.shape
    if weight.all():
        return color
    half = ((width + 1) // 2, (height + 1) // 2)
    share = cast(_Pixels, cv2.resize(weight, half, interpolation=cv2.INTER_AREA))
    sums = cast(_Pixels, cv2.resize(color * weight[..., None], half, interpolation=cv2.INTER_AREA))
    means = cast(_Pixels, sums / np.maximum(share, np.float32(1e-9))[..., None])
    coarse = _pull_and_push(means, (share > 1e-6).astype(np.float32))
    fine = cast(_Pixels, cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.where(weight[..., None] > 0, color, fine)


_Plane = NDArray[np.float32]
_COLOR_SIZES = np.array([1 / 0.14, 1 / 0.08, 1 / 0.08], dtype=np.float32)
"""What brings L, a and b, as shares of 100, to about unit spread over an object's surface, as seen on real textures."""
_SPREAD_SIZES = np.array([1 / 0.03, 1 / 0.02, 1 / 0.02], dtype=np.float32)
"""The same for their spreads within a cell."""
_GRADIENT_SIZE, _HARMONIC_SIZE, _CURVATURE_SIZE = np.float32(3), np.float32(8), np.float32(45)
"""The same for the logarithm of the mean gradient, for relative coefficients, and for curvatures."""
_MIN_GRADIENT = np.float32(0.01)
"""Gradient, in brightness (0 to 1) a pixel, below which an orientation is noise."""


@dataclass(frozen=True)
class ImageDescriptors:
    """Hand-made descriptors of an image's neighborhoods, which are not DINO features.

    Color and spread of color in CIE Lab, orientation histograms' Fourier coefficients 0 to 4, principal curvatures
    of the brightness: 39 features with the default scales.
    """

    longest: int = 256
    """Pixels that the image's longer side is brought to before; scales count in these."""
    stride: int = 2
    """Pixels that one cell of the map stands for."""
    color_scales: tuple[float, ...] = (2.0, 8.0, 32.0)
    """Standard deviations of the Gaussians that colors are averaged over, pixels."""
    texture_scales: tuple[float, ...] = (4.0, 8.0, 16.0)
    """Standard deviations of the soft cells in which orientations, curvatures and spreads are taken, pixels."""

    name: ClassVar[str] = "descriptors"

    def describe(
        self, image: UInt8[Tensor, "height width 3"] | Float[Tensor, "height width 3"]
    ) -> Float[Tensor, "dim rows columns"]:
        """Return the descriptors, each of about unit size, on a grid that covers the image evenly."""
        color = unit_image(image).cpu().numpy()
        factor = self.longest / max(color.shape)
        width, height = (max(1, round(side * factor)) for side in (color.shape[1], color.shape[0]))
        color = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if factor <= 1 else cv2.INTER_LINEAR)
        lab = _plane(cv2.cvtColor(color, cv2.COLOR_RGB2LAB)) / np.float32(100)
        brightness = _plane(lab[..., 0])
        planes = [plane for scale in self.color_scales for plane in _channels(_smooth(lab, scale) * _COLOR_SIZES)]
        for scale in self.texture_scales:
            planes += [*_spreads(lab, scale), *_orientations(brightness, scale), *_curvatures(brightness, scale)]
        cells = -(-width // self.stride), -(-height // self.stride)
        reduced = [cv2.resize(plane, cells, interpolation=cv2.INTER_AREA) for plane in planes]
        return torch.from_numpy(np.stack(reduced)).to(image.device)


def _spreads(lab: _Plane, scale: float) -> list[_Plane]:
    """Return the standard deviation of each color in a Gaussian window."""
    variance = _smooth(lab**2, scale) - _smooth(lab, scale) ** 2
    return _channels(np.sqrt(np.maximum(variance, 0)) * _SPREAD_SIZES)


def _orientations(brightness: _Plane, scale: float) -> list[_Plane]:
    """Return the mean gradient, and the orientation histogram's coefficients relative to it, in a Gaussian window."""
    across, down = _gradient(_smooth(brightness, 1.0))
    strength = _plane(np.hypot(across, down))
    turn = (across + 1j * down) / np.maximum(strength, np.float32(1e-6))
    mean = _smooth(strength, scale)
    planes, power = [_plane(np.log1p(100 * mean)) * _GRADIENT_SIZE], strength.astype(np.complex64)
    # Harmonics 1 to 4 of the histogram.
    for _ in range(4):
        power = power * turn
        magnitude = np.hypot(_smooth(_plane(power.real), scale), _smooth(_plane(power.imag), scale))
        planes.append(_plane(magnitude / (mean + _MIN_GRADIENT)) * _HARMONIC_SIZE)
    return planes


def _curvatures(brightness: _Plane, scale: float) -> list[_Plane]:
    """Return the larger and the smaller eigenvalue of the smoothed brightness's second derivatives."""
    across, down = _gradient(_smooth(brightness, scale))
    (xx, xy), (_, yy) = _gradient(across), _gradient(down)
    middle, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    # Times the scale squared, a blob's curvature is the same at every size.
    factor = _CURVATURE_SIZE * np.float32(scale**2)
    return [_plane(factor * (middle + radius)), _plane(factor * (middle - radius))]


def _smooth(plane: _Plane, scale: float) -> _Plane:
    """Return a plane, or three, under a Gaussian; wide ones at a resolution at which they are 4 to 8 pixels wide."""
    height, width = plane.shape[:2]
    factor = 2 ** max(0, int(np.log2(scale / 4)))
    if factor == 1:
        return _plane(cv2.GaussianBlur(plane, (0, 0), scale, borderType=cv2.BORDER_REPLICATE))
    coarse = cv2.resize(plane, (-(-width // factor), -(-height // factor)), interpolation=cv2.INTER_AREA)
    # Averaging over squares has spread the plane already: a square's variance is a twelfth of its side's square.
    left = float(np.sqrt(scale**2 - (factor**2 - 1) / 12)) / factor
    coarse = cv2.GaussianBlur(coarse, (0, 0), left, borderType=cv2.BORDER_REPLICATE)
    return _plane(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR))


def _channels(planes: _Plane) -> list[_Plane]:
    return [_plane(planes[..., channel]) for channel in range(planes.shape[2])]


def _gradient(plane: _Plane) -> tuple[_Plane, _Plane]:
    """Return the derivatives to the right and downwards, a pixel."""
    across = cv2.Sobel(plane, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8, borderType=cv2.BORDER_REPLICATE)
    down = cv2.Sobel(plane, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8, borderType=cv2.BORDER_REPLICATE)
    return _plane(across), _plane(down)


def _plane(values: object) -> _Plane:
    """Return what OpenCV, or a slice, gives as contiguous float32, which it is typed not to be."""
    return cast(_Plane, np.ascontiguousarray(cast(_Plane, values), dtype=np.float32))
