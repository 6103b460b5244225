"""Masks of an object before a plain background: by color in each image, then by a coarse visual hull of all views.

The background's color may change smoothly over an image.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from avmsf._utils.text import counted, listed
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs.cameras import MIN_VIEWS, Camera, View
from avmsf.photographs.visual_hull import carve, silhouette

Mask = Bool[np.ndarray, "height width"]
ROUNDS = 2
"""Times that masks are made to agree with the hull of the masks before."""
MIN_PART_RATIO = 0.01
"""Area of a part of a first mask over its largest, below which it is a spot in the background."""
MAX_MISSING_LIKELY, MAX_MISSING_POSSIBLE = 0.03, 0.15
"""Views that may miss a place of the object, of all: where shadows are filled, and where there may be object at all."""
MAX_BORDER_DIFFERENCE = 0.3
"""Part of all images' borders that may differ from the background: folds of cloth, an object that leaves the image."""
MAX_BACKGROUND_DIFFERENCE = 64
"""Levels of 255 beyond which no plain background differs from itself, at any threshold."""
MIN_EXPLAINED = 0.7
"""Part of the first masks' pixels that the hull must explain: with less, cameras or masks are wrong."""
BLUR_PIXELS = 2
"""Pixels over which a lens blurs an object's edge, to be given back to the background."""
MIN_NOISE = 4.0
"""Levels of 255 that even a perfectly plain background is allowed: sensor noise and JPEG blocks."""
BORDER_RATIO = 0.02
"""Width of an image's border over its shorter side."""


def find_foreground(views: Sequence[View]) -> tuple[View, ...]:
    """Return the views, with masks for those that had none, which must show the object before a plain background.

    The background's color, which may change smoothly over an image, comes from the images' borders; the object may
    cross them, but must leave most of all borders free. What differs from it in color is object, if the other views
    agree: a coarse visual hull of the first masks drops spots and folds of the background, and fills shadows that are
    as dark as a dark background where nearly all other views show object. So it may also close a narrow gap through
    which only one view in thirty sees the background; wider ones stay open. Masks are 0 or 255. Given masks stay as
    they are and take part in the hull.

    Warns with CaptureWarning of views left out because no object was found in them, and where the views agree on no
    shape. Raises CaptureError for fewer than three views and where no plain background is found.
    """
    if len(views) < MIN_VIEWS:
        wanted, advice = f"at least {MIN_VIEWS} views", "photograph more sides"
        raise CaptureError.expected(wanted, len(views), name="views", advice=advice)
    bare = [index for index, view in enumerate(views) if view.mask is None]
    if not bare:
        return tuple(views)
    # All images' common color stands in where an object covers a whole border.
    common = np.median(np.concatenate([_border(views[index].image.numpy()) for index in bare]), axis=0)
    distances = {index: _background_distance(views[index].image.numpy(), common) for index in bare}
    cut = _background_threshold(list(distances.values()))
    different = [distances[index] > min(cut, MAX_BACKGROUND_DIFFERENCE) for index in bare]
    _check_plain(different, [views[index].name for index in bare])
    masks = [
        view.foreground if view.mask is not None else _large_parts(distances[index] > cut)
        for index, view in enumerate(views)
    ]
    _check_found(masks)
    cameras = [view.camera for view in views]
    for _ in range(ROUNDS):
        outlines = _outlines(masks, cameras)
        if outlines is None:
            message = "the first masks of the views have no common shape; each mask uses only its own image"
            warnings.warn(CaptureWarning(f"{message}; check the masks and the cameras", name="masks"), stacklevel=2)
            break
        for index in bare:
            masks[index] = _agreed(distances[index], cut, *outlines[index])
    for index in bare:
        masks[index] = _trimmed(masks[index], distances[index])
    _check_found(masks)
    empty = [view.name for view, mask in zip(views, masks, strict=True) if view.mask is None and not mask.any()]
    if empty:
        message = f"{counted(len(empty), 'view')} not used, without an object: {listed(empty)}"
        warnings.warn(CaptureWarning(message, name="object", value=empty), stacklevel=2)
    return tuple(
        view if view.mask is not None else replace(view, mask=torch.from_numpy(mask.astype(np.uint8) * np.uint8(255)))
        for view, mask in zip(views, masks, strict=True)
        if view.name not in empty
    )


def _large_parts(mask: Mask) -> Mask:
    """Return the mask without parts that are small compared with its largest."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= MIN_PART_RATIO * areas.max())[labels] & mask if count > 1 else mask


def _outlines(masks: Sequence[Mask], cameras: Sequence[Camera]) -> list[tuple[Mask, Mask, Mask]] | None:
    """Return three outlines of the masks' hull in each view; None where the masks do not fit one shape.

    In the first nearly all views show object; the second is larger by as much as the hull is coarse; in the third most
    views show object, and it is larger likewise.
    """
    hull = carve(masks, cameras)
    if hull is None:
        return None
    # With few views a single one that sees the background weighs: each carves.
    few = hull.occupied(missing=max(int(MAX_MISSING_LIKELY * hull.views), 1) if hull.views >= 8 else 0)
    many = hull.occupied(missing=max(int(MAX_MISSING_POSSIBLE * hull.views), 1))
    few, many = (hull.grid.centers(np.argwhere(each)) for each in (few, many))
    outlines, explained = [], 0
    for mask, camera in zip(masks, cameras, strict=True):
        likely, cell = silhouette(few, hull.grid.spacing, camera)
        possible = _grown(silhouette(many, hull.grid.spacing, camera)[0], cell)
        explained += int((mask & possible).sum())
        outlines.append((likely, _grown(likely, cell), possible))
    return outlines if explained >= MIN_EXPLAINED * sum(int(mask.sum()) for mask in masks) else None


def _agreed(distance: UInt8[np.ndarray, "height width"], cut: int, likely: Mask, near: Mask, possible: Mask) -> Mask:
    """Return a view's mask from its own colors and the hull."""
    # The farther a pixel's color from the background's, the fewer views need to agree: a fold in the background is
    # hardly brighter than the rest of it, and a shadow on the object hardly darker than the cut.
    mask = ((distance > 2 * cut) & possible) | ((distance > cut) & near) | ((distance > cut / 2) & likely)
    holes = ndimage.binary_fill_holes(mask) & ~mask
    count, labels = cv2.connectedComponents(holes.astype(np.uint8), connectivity=4)
    if count > 1:
        total = np.bincount(labels.ravel(), minlength=count)
        supported = np.bincount(labels.ravel(), weights=likely.ravel(), minlength=count)
        mask |= (supported >= 0.8 * total)[labels] & holes
    return cv2.medianBlur(mask.astype(np.uint8), 3) > 0


def _trimmed(mask: Mask, distance: UInt8[np.ndarray, "height width"]) -> Mask:
    """Return the mask without the blur at its edge: pixels less than half as far from the background as next to them.

    The cut is low, for the sake of shadows, and would leave a rim of mixed colors around all that is bright.
    """
    inner = cv2.erode(mask.astype(np.uint8), _disc(BLUR_PIXELS), borderValue=1) > 0
    brightest = cv2.dilate(np.where(mask, distance, 0).astype(np.uint8), _disc(BLUR_PIXELS))
    trimmed = mask & (inner | (2 * distance.astype(np.int32) >= brightest))
    return cv2.medianBlur(trimmed.astype(np.uint8), 3) > 0


def _grown(mask: Mask, pixels: float) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), _disc(max(1, round(pixels)))) > 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _check_plain(different: Sequence[Mask], names: Sequence[str]) -> None:
    """Raise CaptureError where much of the images' borders is no background."""
    borders = [np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) for mask in different]
    share = float(np.concatenate(borders).mean())
    if share > MAX_BORDER_DIFFERENCE:
        got = f"{share:.0%} of the images' borders in other colors ({listed(names)})"
        advice = "give masks, or photograph the object in front of one color with a margin around it"
        raise CaptureError.expected("a plain background", share, got=got, name="background", advice=advice)


def _check_found(masks: Sequence[Mask]) -> None:
    found = sum(bool(mask.any()) for mask in masks)
    if found < MIN_VIEWS:
        wanted = f"an object in front of a plain background in at least {MIN_VIEWS} views"
        got = f"{found} of {len(masks)}"
        raise CaptureError.expected(wanted, found, got=got, name="object", advice="give masks")


def _background_threshold(distances: Sequence[UInt8[np.ndarray, "height width"]]) -> int:
    """Return the greatest distance that is still background, by Otsu's criterion on logarithms, all images together.

    Logarithms, because an object's own colors spread far wider than a background's noise: on the plain scale the dark
    half of a white object in raking light is cut away.
    """
    borders = np.concatenate([_border(distance[..., None]) for distance in distances])
    noise = max(MIN_NOISE, 2 * float(np.median(borders)))
    counts = np.sum([np.bincount(distance.ravel(), minlength=256) for distance in distances], axis=0)
    logarithms = np.log(np.arange(256) + noise)
    below, sums = np.cumsum(counts)[:-1], np.cumsum(counts * logarithms)[:-1]
    total, mean = counts.sum(), (counts * logarithms).sum() / counts.sum()
    between = (mean * below - sums) ** 2 / np.maximum(below * (total - below), 1)
    return max(int(between.argmax()), round(noise))


def _border(image: np.ndarray) -> np.ndarray:
    """Return the pixels along the image's edges."""
    wide = max(1, round(BORDER_RATIO * min(image.shape[:2])))
    strips = (image[:wide], image[-wide:], image[wide:-wide, :wide], image[wide:-wide, -wide:])
    return np.concatenate([strip.reshape(-1, image.shape[2]) for strip in strips])


def _background_distance(image: np.ndarray, common: Float[np.ndarray, " 3"]) -> UInt8[np.ndarray, "height width"]:
    """Return for each pixel how far its color is from the background's: the largest channel's difference, of 255.

    The background is a quadratic in the pixel's position, fitted to the image's border as far as that has about the
    color `common` to all images: so that light falling off to the corners is no object, and an object that covers a
    whole border no background.
    """
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
