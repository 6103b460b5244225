"""The object told from a plain background: by color in each image, then by what all views agree on."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from avmsf._utils.wording import counted
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs.background import distances_from_background, threshold
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.coarse_hull import carve, silhouette
from avmsf.photographs.shots import listed

FEWEST = 3
# Parts of a first mask smaller than this against its largest are taken for spots in the background.
_PART = 0.01
# Views that may miss a place of the object, of all views: for filling shadows, and for what may be object at all.
_FEW, _MANY = 0.03, 0.15
_ROUNDS = 2
# Of all images' borders, what may differ from the background: cloth's folds, and an object that leaves the image.
_BUSY = 0.3
# Levels of 255 that no plain background differs from itself, whatever the cut.
_MOTLEY = 64
# Of the first masks' pixels, what the hull must explain: less, and cameras or masks are wrong.
_EXPLAINED = 0.7
# Pixels over which a lens blurs an object's edge, to be given back to the background.
_BLUR = 2


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
    if len(views) < FEWEST:
        raise CaptureError(
            f"expected at least {FEWEST} views, got {len(views)}; photograph more sides", name="views", value=len(views)
        )
    bare = [index for index, view in enumerate(views) if view.mask is None]
    if not bare:
        return tuple(views)
    distances = dict(zip(bare, distances_from_background([views[index] for index in bare]), strict=True))
    cut = threshold(list(distances.values()))
    _refuse_busy([distances[index] > min(cut, _MOTLEY) for index in bare], [views[index].name for index in bare])
    masks = [
        _large_parts(distances[index] > cut) if view.mask is None else view.mask.numpy() > 127
        for index, view in enumerate(views)
    ]
    _refuse_few([view.name for view, mask in zip(views, masks, strict=True) if mask.any()], len(views))
    cameras = [view.camera for view in views]
    for _ in range(_ROUNDS):
        outlines = _outlines(masks, cameras)
        if outlines is None:
            message = (
                "the first masks of the views have no common shape; each mask uses only its own image; check the masks "
                "and the cameras"
            )
            warnings.warn(CaptureWarning(message, name="masks"), stacklevel=2)
            break
        for index in bare:
            masks[index] = _agreed(distances[index], cut, outlines[index])
    for index in bare:
        masks[index] = _trimmed(masks[index], distances[index])
    return _masked(views, masks)


def background_color(views: Sequence[View]) -> Float[Tensor, " 3"]:
    """Return the median color outside the masks, 0 to 1, each channel on its own; float32.

    Views without a mask do not count, nor do the pixels next to a mask's edge, where object and background mix.
    Raises CaptureError where no pixel lies outside.
    """
    counts = np.zeros((3, 256), dtype=np.int64)
    for view in views:
        if view.mask is not None:
            near = cv2.dilate(view.mask.numpy(), np.ones((5, 5), np.uint8))
            outside = view.image.numpy()[near == 0]
            counts += np.stack([np.bincount(outside[:, channel], minlength=256) for channel in range(3)])
    if not counts.any():
        raise CaptureError(
            "expected views whose masks leave some background, got none; find their foreground first",
            name="background",
            value=0,
        )
    middle = (np.cumsum(counts, axis=1) >= counts.sum(axis=1, keepdims=True) / 2).argmax(axis=1)
    return torch.from_numpy(middle.astype(np.float32) / np.float32(255))


def _large_parts(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the mask without parts that are small beside its largest."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= _PART * areas.max())[labels] & mask if count > 1 else mask


@dataclass(frozen=True, eq=False)
class _Outline:
    """What the hull says of one view."""

    likely: Bool[np.ndarray, "height width"]
    """Nearly all views show object here."""
    possible: Bool[np.ndarray, "height width"]
    """Most do; as large as the hull's coarseness may hide."""
    near: Bool[np.ndarray, "height width"]
    """Likely, and as far around it as the hull is coarse."""


def _outlines(masks: Sequence[Bool[np.ndarray, "height width"]], cameras: Sequence[Camera]) -> list[_Outline] | None:
    """Return each view's outline of the masks' hull; None where the masks do not fit one shape."""
    hull = carve(masks, cameras)
    if hull is None:
        return None
    # With few views a single one that sees the background weighs: each carves.
    few = hull.occupied(missing=max(int(_FEW * hull.views), 1) if hull.views >= 8 else 0)
    many = hull.occupied(missing=max(int(_MANY * hull.views), 1))
    outlines, explained = [], 0
    for mask, camera in zip(masks, cameras, strict=True):
        likely, cube = silhouette(hull, few, camera)
        possible, _ = silhouette(hull, many, camera)
        near, possible = _grown(likely, cube), _grown(possible, cube)
        explained += int((mask & possible).sum())
        outlines.append(_Outline(likely, possible, near))
    return outlines if explained >= _EXPLAINED * sum(int(mask.sum()) for mask in masks) else None


def _agreed(
    distance: UInt8[np.ndarray, "height width"], cut: int, outline: _Outline
) -> Bool[np.ndarray, "height width"]:
    """Return a view's mask from its own colors and the hull."""
    # The farther a pixel's color from the background's, the fewer views need to agree: a fold in the background is
    # hardly brighter than the rest of it, and a shadow on the object hardly darker than the cut.
    mask = (distance > 2 * cut) & outline.possible
    mask |= (distance > cut) & outline.near
    mask |= (distance > cut / 2) & outline.likely
    holes = _enclosed(mask)
    count, labels = cv2.connectedComponents(holes.astype(np.uint8), connectivity=4)
    if count > 1:
        total = np.bincount(labels.ravel(), minlength=count)
        supported = np.bincount(labels.ravel(), weights=outline.likely.ravel(), minlength=count)
        mask |= (supported >= 0.8 * total)[labels] & holes
    return cv2.medianBlur(mask.astype(np.uint8), 3) > 0


def _trimmed(
    mask: Bool[np.ndarray, "height width"], distance: UInt8[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the mask without the blur at its edge: pixels less than half as far from the background as next to them.

    The cut is low, for the sake of shadows, and would leave a rim of mixed colors around all that is bright.
    """
    inner = cv2.erode(mask.astype(np.uint8), _disc(_BLUR), borderValue=1) > 0
    brightest = cv2.dilate(np.where(mask, distance, 0).astype(np.uint8), _disc(_BLUR))
    trimmed = mask & (inner | (2 * distance.astype(np.int32) >= brightest))
    return cv2.medianBlur(trimmed.astype(np.uint8), 3) > 0


def _grown(mask: Bool[np.ndarray, "height width"], pixels: float) -> Bool[np.ndarray, "height width"]:
    return cv2.dilate(mask.astype(np.uint8), _disc(max(1, round(pixels)))) > 0


def _enclosed(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the pixels off the mask from which no way leads to the image's border."""
    outside = np.zeros((mask.shape[0] + 2, mask.shape[1] + 2), dtype=np.uint8)
    outside[1:-1, 1:-1] = mask
    cv2.floodFill(outside, None, (0, 0), 2)
    return outside[1:-1, 1:-1] == 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _refuse_busy(different: Sequence[Bool[np.ndarray, "height width"]], names: Sequence[str]) -> None:
    """Raise CaptureError where much of the images' borders is no background."""
    borders = [np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) for mask in different]
    share = float(np.concatenate(borders).mean())
    if share > _BUSY:
        raise CaptureError(
            f"expected a plain background, got {share:.0%} of the images' borders in other colors ({listed(names)}); "
            "give masks, or photograph the object in front of one color with a margin around it",
            name="background",
            value=share,
        )


def _refuse_few(found: Sequence[str], count: int) -> None:
    if len(found) < FEWEST:
        raise CaptureError(
            f"expected an object in front of a plain background in at least {FEWEST} views, got {len(found)} of "
            f"{count}; give masks",
            name="object",
            value=len(found),
        )


def _masked(views: Sequence[View], masks: Sequence[np.ndarray]) -> tuple[View, ...]:
    found, empty = [], []
    for view, mask in zip(views, masks, strict=True):
        if view.mask is not None:
            found.append(view)
        elif mask.any():
            found.append(replace(view, mask=torch.from_numpy(mask.astype(np.uint8) * np.uint8(255))))
        else:
            empty.append(view.name)
    _refuse_few([view.name for view in found], len(views))
    if empty:
        message = f"{counted(len(empty), 'view')} not used, without an object: {listed(empty)}"
        warnings.warn(CaptureWarning(message, name="object", value=empty), stacklevel=3)
    return tuple(found)
