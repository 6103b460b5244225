"""Views as the fit compares them with renderings: at several sizes, before a background that is decided once."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avmsf.errors import CaptureWarning, SceneError
from avmsf.gaussians.config import SplatConfig
from avmsf.photographs.cameras import Camera, View

_PLAIN_STEP, _PLAIN_PART = 24, 0.9
"""A background is plain where this part of its pixels lies within so many levels of 255 of the median color."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """One view at full size and at each halving."""

    name: str
    cameras: tuple[Camera, ...]
    images: tuple[UInt8[Tensor, "_height _width 3"], ...]
    masks: tuple[UInt8[Tensor, "_height _width"] | None, ...]

    @classmethod
    def of(cls, view: View, *, halvings: int) -> "Photograph":
        """Halve a view `halvings` times, each pixel the mean of the four that it covers."""
        cameras, images, masks = [view.camera], [view.image], [view.mask]
        for _ in range(halvings):
            last = cameras[-1]
            size = (max(1, round(last.width / 2)), max(1, round(last.height / 2)))
            cameras.append(last.resized(*size))
            images.append(_halved(images[-1], size))
            mask = masks[-1]
            masks.append(None if mask is None else _halved(mask, size))
        return cls(view.name, tuple(cameras), tuple(images), tuple(masks))

    def to(self, device: torch.device) -> "Photograph":
        """Return the photograph with its images and masks on a device."""
        masks = tuple(None if mask is None else mask.to(device) for mask in self.masks)
        return replace(self, images=tuple(image.to(device) for image in self.images), masks=masks)


def choose_background(views: Sequence[View], config: SplatConfig) -> Float[Tensor, " 3"] | None:
    """Return the color that the config names, or the one found around the masks, or at the edges of the images.

    Red, green and blue, 0 to 1; None puts another color behind every time, and the same into the photographs. Raises
    `SceneError` for random colors without any mask.
    """
    masked = any(view.mask is not None for view in views)
    if not isinstance(config.background, str):
        return torch.tensor(config.background)
    if config.background == "random":
        if not masked:
            raise SceneError.expected(
                "a color, or views with masks for random ones", "random", got="random without masks", name="background"
            )
        return None
    pixels = np.concatenate([_outside(view) for view in views])
    if not len(pixels):
        return torch.zeros(3)
    color = np.median(pixels, axis=0)
    plain = float((np.abs(pixels - color).max(1) <= _PLAIN_STEP).mean()) >= _PLAIN_PART
    # Without a mask there is no other way than to fit the whole photograph.
    return torch.from_numpy(color / 255.0).float() if plain or not masked else None


def prepare_photographs(
    views: Sequence[View], background: Float[Tensor, " 3"] | None, *, halvings: int
) -> list[Photograph]:
    """Return the views that can be compared: all, or before random colors those with a mask.

    A mask without the object says nothing of its shape: its view is left out. `visual_hull` warns of it. Raises
    SceneError where fewer than 3 views are left.
    """
    kept = [view for view in views if view.mask is None or bool((view.mask > 127).any())]
    if background is None:
        unknown = [view.name for view in kept if view.mask is None]
        if unknown:
            message = f"views without a mask are not used, since the background is not plain: {', '.join(unknown)}"
            warnings.warn(CaptureWarning(message, name="masks", value=unknown), stacklevel=3)
        kept = [view for view in kept if view.mask is not None]
    if len(kept) < 3:
        got = f"{len(kept)} of {len(views)} that can be used"
        raise SceneError.expected("3 or more", len(kept), got=got, name="views", advice="give more")
    return [Photograph.of(view, halvings=halvings) for view in kept]


def _outside(view: View) -> np.ndarray:
    """Return some of the pixels that are surely background, or of the image's edge where there is no mask."""
    image = view.image.numpy()
    if view.mask is None:
        edges = (image[0], image[-1], image[:, 0], image[:, -1])
        return np.concatenate(edges)
    surely = cv2.dilate(view.mask.numpy(), np.ones((5, 5), np.uint8)) == 0
    return image[surely][::17]


def _halved(image: Tensor, size: tuple[int, int]) -> Tensor:
    return torch.from_numpy(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA))
