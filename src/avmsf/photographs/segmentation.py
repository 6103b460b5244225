"""Masks of an object before a plain background: by color in each image, then by a coarse visual hull of all views.

The background's color may change smoothly over an image.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from avmsf._utils.text import counted, listed
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs.cameras import Camera, View, nearest_to_lines

MIN_VIEWS = 3
# Parts of a first mask smaller than this against its largest are taken for spots in the background.
MIN_PART = 0.01
# Views that may miss a place of the object, of all views: for filling shadows, and for what may be object at all.
MAX_MISSING_LIKELY, MAX_MISSING_POSSIBLE = 0.03, 0.15
ROUNDS = 2
# Of all images' borders, what may differ from the background: cloth's folds, and an object that leaves the image.
MAX_BORDER_DIFFERENCE = 0.3
# Levels of 255 that no plain background differs from itself, whatever the cut.
MAX_BACKGROUND_DIFFERENCE = 64
# Of the first masks' pixels, what the hull must explain: less, and cameras or masks are wrong.
MIN_EXPLAINED = 0.7
# Pixels over which a lens blurs an object's edge, to be given back to the background.
BLUR_PIXELS = 2
# Levels of 255 that even a perfectly plain background is allowed: sensor noise and JPEG blocks.
MIN_NOISE = 4.0
# The share of an image's shorter side that counts as its border.
BORDER = 0.02
# Cubes of the hull on its first and its second grid.
COARSE_CELLS, FINE_CELLS = 40**3, 80**3
# Of the views that could see a place, so many at least must be there to say anything of it.
MIN_SEEING = 1 / 3


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
        raise CaptureError.expected(
            f"at least {MIN_VIEWS} views", len(views), name="views", advice="photograph more sides"
        )
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
        _large_parts(distances[index] > cut) if view.mask is None else view.mask.numpy() > 127
        for index, view in enumerate(views)
    ]
    _refuse_few(masks)
    cameras = [view.camera for view in views]
    for _ in range(ROUNDS):
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
    _refuse_few(masks)
    empty = [view.name for view, mask in zip(views, masks, strict=True) if view.mask is None and not mask.any()]
    if empty:
        message = f"{counted(len(empty), 'view')} not used, without an object: {listed(empty)}"
        warnings.warn(CaptureWarning(message, name="object", value=empty), stacklevel=2)
    return tuple(
        view if view.mask is not None else replace(view, mask=torch.from_numpy(mask.astype(np.uint8) * np.uint8(255)))
        for view, mask in zip(views, masks, strict=True)
        if view.name not in empty
    )


def _large_parts(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the mask without parts that are small beside its largest."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= MIN_PART * areas.max())[labels] & mask if count > 1 else mask


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
    few = hull.occupied(missing=max(int(MAX_MISSING_LIKELY * hull.views), 1) if hull.views >= 8 else 0)
    many = hull.occupied(missing=max(int(MAX_MISSING_POSSIBLE * hull.views), 1))
    outlines, explained = [], 0
    for mask, camera in zip(masks, cameras, strict=True):
        likely, cube = silhouette(hull, few, camera)
        possible, _ = silhouette(hull, many, camera)
        near, possible = _grown(likely, cube), _grown(possible, cube)
        explained += int((mask & possible).sum())
        outlines.append(_Outline(likely, possible, near))
    return outlines if explained >= MIN_EXPLAINED * sum(int(mask.sum()) for mask in masks) else None


def _agreed(
    distance: UInt8[np.ndarray, "height width"], cut: int, outline: _Outline
) -> Bool[np.ndarray, "height width"]:
    """Return a view's mask from its own colors and the hull."""
    # The farther a pixel's color from the background's, the fewer views need to agree: a fold in the background is
    # hardly brighter than the rest of it, and a shadow on the object hardly darker than the cut.
    mask = (distance > 2 * cut) & outline.possible
    mask |= (distance > cut) & outline.near
    mask |= (distance > cut / 2) & outline.likely
    holes = ndimage.binary_fill_holes(mask) & ~mask
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
    inner = cv2.erode(mask.astype(np.uint8), _disc(BLUR_PIXELS), borderValue=1) > 0
    brightest = cv2.dilate(np.where(mask, distance, 0).astype(np.uint8), _disc(BLUR_PIXELS))
    trimmed = mask & (inner | (2 * distance.astype(np.int32) >= brightest))
    return cv2.medianBlur(trimmed.astype(np.uint8), 3) > 0


def _grown(mask: Bool[np.ndarray, "height width"], pixels: float) -> Bool[np.ndarray, "height width"]:
    return cv2.dilate(mask.astype(np.uint8), _disc(max(1, round(pixels)))) > 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _check_plain(different: Sequence[Bool[np.ndarray, "height width"]], names: Sequence[str]) -> None:
    """Raise CaptureError where much of the images' borders is no background."""
    borders = [np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]) for mask in different]
    share = float(np.concatenate(borders).mean())
    if share > MAX_BORDER_DIFFERENCE:
        raise CaptureError.expected(
            "a plain background",
            share,
            got=f"{share:.0%} of the images' borders in other colors ({listed(names)})",
            name="background",
            advice="give masks, or photograph the object in front of one color with a margin around it",
        )


def _refuse_few(masks: Sequence[Bool[np.ndarray, "height width"]]) -> None:
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
    wide = max(1, round(BORDER * min(image.shape[:2])))
    strips = (image[:wide], image[-wide:], image[wide:-wide, :wide], image[wide:-wide, -wide:])
    return np.concatenate([strip.reshape(-1, image.shape[2]) for strip in strips])


def _background_distance(image: np.ndarray, common: Float[np.ndarray, " 3"]) -> UInt8[np.ndarray, "height width"]:
    """Return for each pixel how far its color is from the background's: the largest channel's difference, of 255.

    The background is a quadratic in the pixel's place, fitted to the image's border as far as that has about the color
    `common` to all images: so that light falling off to the corners is no object, and an object that covers a whole
    border no background.
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


@dataclass(frozen=True, eq=False)
class Hull:
    """Cubes around an object with the votes of the views on each."""

    centers: Float[np.ndarray, "places 3"]
    """Object frame, meters."""
    edge: float
    """Of a cube, meters."""
    seeing: Int[np.ndarray, " places"]
    """How many views have the place inside their image."""
    agreeing: Int[np.ndarray, " places"]
    """How many of these show object there."""
    views: int
    """How many views voted."""

    def occupied(self, *, missing: int) -> Bool[np.ndarray, " places"]:
        """Return which places are object, where up to `missing` views, of as many as voted, may say otherwise."""
        allowed = np.floor(missing * self.seeing / self.views)
        enough = self.seeing >= max(2.0, MIN_SEEING * self.views)
        return enough & (self.agreeing >= self.seeing - allowed)


def carve(masks: Sequence[Bool[np.ndarray, "height width"]], cameras: Sequence[Camera]) -> Hull | None:
    """Return the hull of the masks; None where they and their cameras agree on no place at all."""
    bounds = _bounds(masks, cameras)
    if bounds is None:
        return None
    coarse = _vote(*bounds, COARSE_CELLS, masks, cameras)
    inside = coarse.occupied(missing=len(masks) // 6)
    if not inside.any():
        return None
    low = coarse.centers[inside].min(axis=0) - 1.5 * coarse.edge
    high = coarse.centers[inside].max(axis=0) + 1.5 * coarse.edge
    return _vote(low, high, FINE_CELLS, masks, cameras)


def silhouette(
    hull: Hull, places: Bool[np.ndarray, " places"], camera: Camera
) -> tuple[Bool[np.ndarray, "height width"], float]:
    """Return where the given places lie in the camera's image, and how large a cube is there, pixels.

    The outline is as coarse as the cubes.
    """
    across, down, depth = _pixels(hull.centers[places], camera)
    ahead = depth > 0
    if not ahead.any():
        return np.zeros((camera.height, camera.width), dtype=bool), 1.0
    footprint = max(camera.focal) * hull.edge / float(np.median(depth[ahead]))
    # A cube covers at most one pixel of an image this small, so that neighbors leave no gap that closing leaves open.
    shrink = max(1.0, footprint)
    width, height = int(np.ceil(camera.width / shrink)), int(np.ceil(camera.height / shrink))
    columns, rows = np.floor(across / shrink), np.floor(down / shrink)
    seen = ahead & (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
    small = np.zeros((height, width), dtype=np.uint8)
    small[rows[seen].astype(int), columns[seen].astype(int)] = 1
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    column = np.minimum((np.arange(camera.width) + 0.5) / shrink, width - 1).astype(int)
    row = np.minimum((np.arange(camera.height) + 0.5) / shrink, height - 1).astype(int)
    return closed[row[:, None], column[None, :]] > 0, footprint


def _bounds(
    masks: Sequence[Bool[np.ndarray, "height width"]], cameras: Sequence[Camera]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]] | None:
    """Return the corners of a box that holds the object: the middles of the masks looked at from all sides."""
    directions, positions, angles = [], [], []
    for mask, camera in zip(masks, cameras, strict=True):
        rows, columns = np.nonzero(mask)
        if not len(rows):
            continue
        across = (columns + 0.5 - camera.principal[0]) / camera.focal[0]
        down = (rows + 0.5 - camera.principal[1]) / camera.focal[1]
        ray = camera.world_to_camera[:3, :3].numpy().T @ (across.mean(), down.mean(), 1.0)
        directions.append(ray / np.linalg.norm(ray))
        positions.append(camera.position.numpy())
        angles.append(float(np.hypot(across - across.mean(), down - down.mean()).max()))
    if len(directions) < 2:
        return None
    places = np.array(positions)
    center = nearest_to_lines(places, np.array(directions))
    if center is None:
        return None
    # The median, for a mask that leaked into the background is far too large.
    radius = 1.25 * float(np.median(np.array(angles) * np.linalg.norm(places - center, axis=1)))
    return center - radius, center + radius


def _vote(
    low: Float[np.ndarray, " 3"],
    high: Float[np.ndarray, " 3"],
    count: int,
    masks: Sequence[Bool[np.ndarray, "height width"]],
    cameras: Sequence[Camera],
) -> Hull:
    """Return the votes on about `count` cubes that fill a box."""
    edge = float(np.prod(high - low) / count) ** (1 / 3)
    steps = np.maximum(1, np.ceil((high - low) / edge)).astype(int)
    axes = [low[axis] + (np.arange(steps[axis]) + 0.5) * edge for axis in range(3)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    seeing, agreeing = np.zeros(len(centers), dtype=np.int64), np.zeros(len(centers), dtype=np.int64)
    for mask, camera in zip(masks, cameras, strict=True):
        across, down, depth = _pixels(centers, camera)
        seen = (depth > 0) & (across >= 0) & (down >= 0) & (across < camera.width) & (down < camera.height)
        rows, columns = down[seen].astype(np.int32), across[seen].astype(np.int32)
        seeing += seen
        agreeing[seen] += mask[rows, columns]
    return Hull(centers, edge, seeing, agreeing, len(masks))


def _pixels(
    points: Float[np.ndarray, "points 3"], camera: Camera
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return columns, rows and depths of points; single precision, which is a thousandth of a pixel here."""
    pose = camera.world_to_camera.numpy().astype(np.float32)
    inside = points.astype(np.float32) @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(inside[:, 2] > 0, inside[:, 2], np.float32(1.0))
    across = inside[:, 0] / depth * np.float32(camera.focal[0]) + np.float32(camera.principal[0])
    down = inside[:, 1] / depth * np.float32(camera.focal[1]) + np.float32(camera.principal[1])
    return across, down, inside[:, 2]
