"""The outlines of masks: how far inside all of them each cell of a grid lies, and how far the masks can be trusted.

The first is the visual hull as a signed distance. Of masks, some contradict the others, and all may be too large or
too small by the same number of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from avmsf.mesh.level_set import Grid, enclose
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.photographs.visual_hull import project_votes

_SUBPIXELS = 3
"""Times as many pixels across in which the distance to an outline is measured. It must be odd."""

_OUTSIDE_M = np.float32(1e6)
"""Meters outside, of what is not known to be inside."""


@dataclass(frozen=True, eq=False)
class Outline:
    """The outline of an object in one view."""

    camera: Camera
    inside: Float32[np.ndarray, "height width"]
    """How far inside the outline the middle of each pixel lies, pixels; negative outside."""

    @classmethod
    def of(cls, view: View) -> "Outline":
        """Return the outline in a view's mask: where it covers half of a pixel, between pixels by interpolation."""
        assert view.mask is not None
        return cls(view.camera, _inside(view.mask.numpy()))

    @property
    def focal(self) -> float:
        """The camera's focal length, pixels."""
        return float(np.sqrt(self.camera.focal[0] * self.camera.focal[1]))

    def moved_in(self, pixels: float) -> "Outline":
        """Return the outline moved inwards by so many pixels."""
        return replace(self, inside=self.inside - np.float32(pixels))


def _inside(mask: np.ndarray) -> Float32[np.ndarray, "height width"]:
    """Return the signed distance of each pixel's middle from the outline, pixels."""
    height, width = mask.shape
    fine = cv2.resize(mask, (width * _SUBPIXELS, height * _SUBPIXELS), interpolation=cv2.INTER_LINEAR) > 127
    if fine.all() or not fine.any():
        return np.full(mask.shape, float(max(mask.shape)) * (1.0 if fine.all() else -1.0), dtype=np.float32)
    solid = fine.astype(np.uint8)
    within = cv2.distanceTransform(solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - solid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Each counts to the middle of the first pixel of the other side, half a pixel beyond the outline.
    signed = np.where(fine, within - 0.5, 0.5 - beyond) / _SUBPIXELS
    middle = _SUBPIXELS // 2
    return np.ascontiguousarray(signed[middle::_SUBPIXELS, middle::_SUBPIXELS], dtype=np.float32)


def hull_distance(
    outlines: Sequence[Outline], grid: Grid, where: Bool[np.ndarray, "x y z"] | None = None, *, rank: int
) -> Float32[np.ndarray, "x y z"]:
    """Return how far inside the hull each cell's middle lies, meters.

    The distance is the `rank`-th smallest (0 for the smallest) over views of the distance from the outline at the
    cell's depth, negative outside. It is -1e6 where fewer than half as many views have the cell in their image as have
    any, and in cells that are not `where`.
    """
    cells = np.flatnonzero(np.ones(grid.shape, dtype=bool) if where is None else where)
    least = np.full((rank + 1, len(cells)), np.inf, dtype=np.float32)
    seen = np.zeros(len(cells), dtype=np.uint16)

    def keep_least(part: slice, view: int, values: np.ndarray, depths: np.ndarray) -> None:
        distances = (values * depths / outlines[view].focal).astype(np.float32)
        seen[part] += ~np.isnan(values)
        for row in least[:, part]:
            distances, row[:] = np.fmax(row, distances), np.fmin(row, distances)

    cameras, images = [each.camera for each in outlines], [each.inside for each in outlines]
    project_votes(grid, cells, cameras, images, keep_least, linear=True)
    # Of what few views have in their image nothing is known, and the object is in most of them.
    known = np.isfinite(least[rank]) & (seen >= 0.5 * seen.max(initial=0))
    distance = np.full(grid.shape, -_OUTSIDE_M, dtype=np.float32)
    distance.ravel()[cells] = np.where(known, least[rank], -_OUTSIDE_M)
    return distance


WRONG_FRACTION = 0.05
"""Part of the masks that may be wrong."""
_MAX_LEFT_OUT = 0.002
"""Part of the consensus that a right mask leaves out in most views (median over 20 objects with 72 views: 0)."""
_MAX_LEFT_OUT_ALONE = 0.15
"""Part of the consensus that a mask which shows nothing beyond it leaves out if it is wrong, unless depth has nothing
there either. One view in twelve, which alone saw under a dish, leaves out .096; of the other objects' right masks none
leaves out more than .07; one along a channel, which alone looks through it, most of it."""
_MAX_BEYOND = 0.01
"""Part of a mask beyond the consensus from which on it is wrong. Right masks of the 20 objects have .0000; nine in ten
mirrored ones have .015 and more, unless the object looks the same from there."""
_MIN_MEDIAN_RATIO = 4.0
"""Both parts must also be so many times the median over views: where all cameras are inexact, no mask is wrong."""
_MAX_OFFSET_PIXELS, _BIN_PIXELS = 4.0, 0.25
"""Pixels on both sides of outlines in which edges are searched, and the width of a bin."""
_MIN_PEAK_RATIO = 3.0
"""Gradient at an edge over its median within reach, from which on it is one. The 20 objects have 5 to 18."""


def edge_offset(views: Sequence[View], outlines: Sequence[Outline]) -> float:
    """Return how far inside the outlines of masks the edges in the photographs lie, pixels; negative outside.

    All masks count together: the mean gradient of the photographs by the distance from the outline has its peak there.
    It is 0 where no peak within 3 pixels stands out. On 19 objects, masks eroded or dilated by 1 or 2 pixels, it is
    right within .2 pixels.
    """
    bins = round(2 * _MAX_OFFSET_PIXELS / _BIN_PIXELS)
    total, count = np.zeros(bins), np.zeros(bins)
    for view, outline in zip(views, outlines, strict=True):
        smooth = cv2.GaussianBlur(view.image.numpy().astype(np.float32), (0, 0), 0.7)
        gradient = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
        chosen = np.floor((outline.inside + _MAX_OFFSET_PIXELS) / _BIN_PIXELS).astype(int)
        near = (chosen >= 0) & (chosen < bins)
        total += np.bincount(chosen[near], gradient.max(axis=2)[near], minlength=bins)
        count += np.bincount(chosen[near], minlength=bins)
    mean = total / np.maximum(count, 1)
    peak, usual = int(mean.argmax()), float(np.median(mean))
    pixels = (np.arange(bins) + 0.5) * _BIN_PIXELS - _MAX_OFFSET_PIXELS
    if not mean[peak] > _MIN_PEAK_RATIO * usual or abs(pixels[peak]) > _MAX_OFFSET_PIXELS - 1:
        return 0.0
    # The middle of the peak's upper half.
    weight = np.maximum(mean - (mean[peak] + usual) / 2, 0.0) * (np.abs(pixels - pixels[peak]) < 2)
    return float((weight * pixels).sum() / weight.sum())


def consistent_masks(
    views: Sequence[View],
    outlines: Sequence[Outline],
    depths: Sequence[Float32[np.ndarray, "height width"]],
    grid: Grid,
) -> Bool[np.ndarray, " views"]:
    """Return which masks agree with the consensus of all, on a grid around the object.

    The consensus is what all but 5 % of the masks keep. A right mask may leave out a part of it that few other views
    could see, but shows nothing beyond it; one that does both is wrong, and one that leaves out much in which its view
    has `depths`, meters, in most pixels: 0 where nothing is. At least half of the masks agree, for a wrong one leaves
    out more than the median.
    """
    values = hull_distance(outlines, grid, rank=round(WRONG_FRACTION * len(outlines)))
    solid = values > 0
    if not solid.any():
        return np.ones(len(outlines), dtype=bool)
    cut = np.array([_left_out(each, grid, solid) for each in outlines])
    inconsistent = cut > max(_MAX_LEFT_OUT, _MIN_MEDIAN_RATIO * float(np.median(cut)))
    if not inconsistent.any():
        return ~inconsistent
    # Half a cell larger, for cells are coarse.
    values = np.maximum(values + 0.5 * np.float32(grid.spacing), -grid.spacing)
    tracer = MeshTracer(enclose(values, grid))
    seen = [(tracer.depth(view.camera) > 0).numpy() for view in views]
    beyond = np.array([_part(~there, each.inside > 1) for each, there in zip(outlines, seen, strict=True)])
    shown = beyond > max(_MAX_BEYOND, _MIN_MEDIAN_RATIO * float(np.median(beyond)))
    # Outermost pixels are the background's in part.
    filled = [
        _part(depth > 0, there & (each.inside < -1)) for depth, each, there in zip(depths, outlines, seen, strict=True)
    ]
    return ~(inconsistent & (shown | ((cut > _MAX_LEFT_OUT_ALONE) & (np.array(filled) > 0.5))))


def _left_out(outline: Outline, grid: Grid, solid: Bool[np.ndarray, "x y z"]) -> float:
    distance: Float32[np.ndarray, "x y z"] = hull_distance([outline], grid, solid, rank=0)
    return float((distance[solid] < -0.5 * grid.spacing).mean())


def _part(found: Bool[np.ndarray, "height width"], among: Bool[np.ndarray, "height width"]) -> float:
    """Return the part of some pixels in which something is found; 0 of none."""
    return float((found & among).sum() / max(int(among.sum()), 1))
