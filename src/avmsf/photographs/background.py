"""A plain background's color, which may change smoothly over an image, and how far from it an object begins."""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from avmsf.photographs.cameras import View

# Levels of 255 that even a perfectly plain background is allowed: sensor noise and JPEG blocks.
_NOISE = 4.0
# The share of an image's shorter side that counts as its border.
_BORDER = 0.02


def distances_from_background(views: Sequence[View]) -> list[UInt8[np.ndarray, "height width"]]:
    """Return for each pixel how far its color is from the background's: the largest channel's difference, of 255.

    Each image's background is a quadratic in the pixel's place, fitted to its border and to that of all images: so
    that light falling off to the corners is no object, and an object that covers a whole border no background.
    """
    common = np.median(np.concatenate([_border(view.image.numpy()) for view in views]), axis=0)
    return [_distance(view.image.numpy(), common) for view in views]


def threshold(distances: Sequence[UInt8[np.ndarray, "height width"]]) -> int:
    """Return the greatest distance that is still background, by Otsu's criterion on logarithms, all images together.

    Logarithms, because an object's own colors spread far wider than a background's noise: on the plain scale the dark
    half of a white object in raking light is cut away.
    """
    borders = np.concatenate([_border(distance[..., None]) for distance in distances])
    noise = max(_NOISE, 2 * float(np.median(borders)))
    counts = np.sum([np.bincount(distance.ravel(), minlength=256) for distance in distances], axis=0)
    logarithms = np.log(np.arange(256) + noise)
    below, sums = np.cumsum(counts)[:-1], np.cumsum(counts * logarithms)[:-1]
    total, mean = counts.sum(), (counts * logarithms).sum() / counts.sum()
    between = (mean * below - sums) ** 2 / np.maximum(below * (total - below), 1)
    return max(int(between.argmax()), round(noise))


def _border(image: np.ndarray) -> np.ndarray:
    """Return the pixels along the image's edges."""
    wide = max(1, round(_BORDER * min(image.shape[:2])))
    strips = (image[:wide], image[-wide:], image[wide:-wide, :wide], image[wide:-wide, -wide:])
    return np.concatenate([strip.reshape(-1, image.shape[2]) for strip in strips])


def _distance(image: np.ndarray, common: Float[np.ndarray, " 3"]) -> UInt8[np.ndarray, "height width"]:
    terms = _terms(*image.shape[:2])
    at, colors = _border(terms), _border(image).astype(np.float64)
    background = np.broadcast_to(common, image.shape)
    expected = np.broadcast_to(common, colors.shape)
    for tolerance in (48.0, 24.0, 24.0):
        # Colors far from what is expected belong to the object, where it leaves the image.
        plain = np.abs(colors - expected).max(axis=1) < tolerance
        if plain.sum() < 0.25 * len(colors):
            break
        weights = np.linalg.lstsq(at[plain], colors[plain], rcond=None)[0]
        expected, background = at @ weights, np.clip(terms @ weights.astype(np.float32), 0, 255)
    # The median takes noise out and leaves edges where they are.
    smooth = cv2.medianBlur(image, 3)
    return np.round(np.abs(smooth - background.astype(np.float32)).max(axis=2)).astype(np.uint8)


@lru_cache(maxsize=1)
def _terms(height: int, width: int) -> Float[np.ndarray, "height width terms"]:
    """Return 1, x, y, x², xy, y² at each pixel, x and y from -1 to 1."""
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).astype(np.float32)
