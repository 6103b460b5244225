"""Views as the fit compares them with renderings: at several sizes, before a background that is decided once."""

import warnings
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.errors import CaptureWarning, SceneError
from avmsf.gaussians.config import SplatConfig
from avmsf.photographs.cameras import MIN_VIEWS, View

_MAX_PLAIN_STEP, _MIN_PLAIN_FRACTION = 24, 0.9
"""A background is plain where this part of its pixels lies within so many levels of 255 of the median color."""


def pyramid(view: View, *, halvings: int) -> list[View]:
    """Return a view at full size and after each halving, of which every pixel is the mean of the four it covers."""
    levels = [view]
    for _ in range(halvings):
        last = levels[-1]
        size = max(1, round(last.camera.width / 2)), max(1, round(last.camera.height / 2))
        mask = None if last.mask is None else _resized(last.mask, size)
        levels.append(View(view.name, _resized(last.image, size), last.camera.resized(*size), mask))
    return levels


def choose_background(views: Sequence[View], config: SplatConfig) -> Float[Tensor, " 3"] | None:
    """Return the color that the config names, or the one found around the masks, or at the edges of the images.

    Red, green and blue, 0 to 1; None puts another color behind every time, and the same into the photographs. Raises
    `SceneError` for random colors without any mask.
    """
    masked = any(view.mask is not None for view in views)
    if not isinstance(config.background, str):
        return torch.tensor(config.background, dtype=torch.float32)
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
    plain = float((np.abs(pixels - color).max(1) <= _MAX_PLAIN_STEP).mean()) >= _MIN_PLAIN_FRACTION
    # Without a mask there is no other way than to fit the whole photograph.
    return torch.from_numpy(color / 255.0).float() if plain or not masked else None


def comparable_views(views: Sequence[View], background: Float[Tensor, " 3"] | None) -> list[View]:
    """Return the views that renderings can be compared with: all, or before random colors those with a mask.

    A mask without the object says nothing of its shape: its view is left out. `visual_hull` warns of it. Raises
    SceneError where fewer than 3 views are left.
    """
    kept = [view for view in views if view.mask is None or view.foreground.any()]
    if background is None:
        unknown = [view.name for view in kept if view.mask is None]
        if unknown:
            message = f"views without a mask are not used, since the background is not plain: {', '.join(unknown)}"
            warnings.warn(CaptureWarning(message, name="masks", value=unknown), stacklevel=3)
        kept = [view for view in kept if view.mask is not None]
    if len(kept) < MIN_VIEWS:
        got = f"{len(kept)} of {len(views)} that can be used"
        raise SceneError.expected(f"{MIN_VIEWS} or more", len(kept), got=got, name="views", advice="give more")
    return kept


def _outside(view: View) -> np.ndarray:
    """Return some of the pixels that are surely background, or of the image's edge where there is no mask."""
    image = view.image.numpy()
    if view.mask is None:
        edges = (image[0], image[-1], image[:, 0], image[:, -1])
        return np.concatenate(edges)
    surely = cv2.dilate(view.mask.numpy(), np.ones((5, 5), np.uint8)) == 0
    return image[surely][::17]


def _resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    return torch.from_numpy(cv2.resize(image.numpy(), size, interpolation=cv2.INTER_AREA))
