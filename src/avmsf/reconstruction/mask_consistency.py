"""How far masks can be trusted: which contradict the others, and by how much all are too large or too small."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32

from avmsf.photographs.cameras import View
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.photographs.visual_hull import Grid
from avmsf.reconstruction.hull_distance import Outline, hull_distance
from avmsf.reconstruction.object_shape import closed_surface

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
    tracer = MeshTracer(closed_surface(values, grid))
    seen = [torch.isfinite(tracer.depth(view.camera)).numpy() for view in views]
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
