"""What turns an image into features: one interface for networks, for descriptors without any, for anyone's own.

A feature map covers its image evenly, whatever its size: cell [row, column] stands for the rectangle that many equal
columns and rows cut out, so that its center lies at ((column + 1/2) width / columns, (row + 1/2) height / rows) pixels.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol, cast, runtime_checkable

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
        down, across = (_interpolation(side, self.patch).to(found) for side in (height, width))
        return (down @ found @ across.T).to(image.device)


def _interpolation(length: int, patch: int) -> Float[Tensor, "cells patches"]:
    """Return what interpolates linearly from patches' centers to those of as many equal cells of `length` pixels.

    The identity where the patches end with the image.
    """
    count = -(-length // patch)
    places = (torch.arange(count, dtype=torch.float64) + 0.5) * length / count / patch - 0.5
    places = places.clamp(0.0, count - 1.0)
    return (1 - (places[:, None] - torch.arange(count)).abs()).clamp(min=0.0)


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
