"""The visual hull as a signed distance: how far inside the outlines of all masks each cell of a grid lies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.visual_hull import Grid, project_votes

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
