"""An object's shape on a grid: its outer side, its cavities, and the bodies that it may be."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int
from scipy import ndimage

from avmsf._utils.caching import content_digest, source_digest
from avmsf.errors import SceneError
from avmsf.mesh.level_set import Grid, difference, enclose
from avmsf.mesh.surface import Surface
from avmsf.reconstruction.distance import distance_from

MAX_FACES = 6000
"""Triangles at most of a body's surface: tetrahedra of 12,000 to 40,000 degrees of freedom have no more outside."""
_MIN_HALF_THICKNESS = 0.03
"""Half the thickness beyond the wall's, over the diagonal, below which a part is solid unless seen to be hollow:
handles are. By trial: .06 for the thickness (mugs, jugs, pans)."""
_MIN_LID_COSINE = 0.8
"""Cosine of the angle to a lid's normal within which the rim next to it belongs to the lid."""
_LID_GROWTH = 0.6
"""How far a lid grows over the rim, and over floors that were not seen to lie below it, over the radius of a disc of
its area."""
LID_BLUR = 0.05
"""Standard deviation of the Gaussian blur of a lid's normals, over the diagonal: twice as far as faces that no outline
touches end before their edges, where normals are those of the rim. Tried on a tube, a dome and an angle bar."""
_MIN_REPORTED_PIXELS = 0.5
"""Pixels by which outlines are moved, from which on the user hears of it; masks that the package finds take .2."""
_MIN_THICKNESS, _MAX_THICKNESS = 0.0025, 0.06
"""Wall thicknesses over the diagonal that are worth trying. Of the 20 simulated objects a tube has the least, .0027,
and thinner walls take more elements than a model has."""
_BLUR_CELLS = 0.6
"""Standard deviation of the blur that takes steps out of surfaces, cells."""


@dataclass(frozen=True)
class ShapeReport:
    """What is known of how good a shape is."""

    rejected: tuple[str, ...]
    """Names of the views whose masks contradict the others'."""
    mask_offset: float
    """How far inside the masks' outlines the photographs' edges lay, pixels; outlines were moved there."""
    unseen: float
    """Part of the surface, 0 to 1, that no view saw; it was closed by the convex hull of what was seen."""


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """The outer side of an object and its cavities, as signed distances on a grid; positive inside."""

    grid: Grid
    outer: Float32[np.ndarray, "x y z"]
    """Meters inside the outer side, with cavities filled up to flat lids; exact near the surface only."""
    seen: Float32[np.ndarray, "x y z"]
    """Meters inside what views show, cavities empty as far as seen; exact near the surface only."""
    hollow: Int[np.ndarray, "x y z"]
    """Number of the cavity, from 1, that each cell was seen to be in; 0 elsewhere."""
    supposed: bool
    """Whether no view saw into the cavities: they only may be there, behind flat faces."""
    diagonal: float
    """Of the box around the object, meters."""
    report: ShapeReport

    @property
    def thickness_range(self) -> tuple[float, float] | None:
        """Least and largest thickness of walls around the cavities that the views allow, meters; None without any.

        Views see into a cavity no farther than to its wall, so that a wall is hardly thicker than what they leave.
        """
        if not self.hollow.any():
            return None
        if self.supposed:
            return _MIN_THICKNESS * self.diagonal, _MAX_THICKNESS * self.diagonal
        rim = (self.hollow > 0) & ndimage.binary_dilation((self.hollow == 0) & (self.outer > 0)) & ~self._lids
        left = 1.5 * float(np.quantile(self._depth[rim], 0.5)) if rim.any() else 0.0
        most = min(max(left, 3 * _MIN_THICKNESS * self.diagonal), _MAX_THICKNESS * self.diagonal)
        return _MIN_THICKNESS * self.diagonal, most

    def solid(self, *, faces: int = MAX_FACES) -> Surface:
        """Return the outer side, cavities filled."""
        return self._enclose(self.outer, self.grid, faces)

    def as_seen(self) -> Surface:
        """Return what views show: both sides of walls where both were seen."""
        return self._as_seen

    @cached_property
    def _as_seen(self) -> Surface:
        return self._enclose(self.seen, self.grid, 2 * MAX_FACES)

    def closed(self) -> "ObjectShape | None":
        """Return the shape around a cavity without an opening; None unless it is thick enough and has supposed ones.

        Bottles are such bodies, but for a mouth too narrow to be seen into.
        """
        within = np.where(self.outer > 0, distance_from(self.outer) * np.float32(self.grid.spacing), np.float32(0.0))
        deep = within > _MIN_HALF_THICKNESS * self.diagonal
        possible = self.supposed and self._lids.any() and deep.any()
        return replace(self, hollow=deep.astype(np.int32)) if possible else None

    def shell(self, thickness: float, *, faces: int = MAX_FACES) -> Surface:
        """Return the body whose walls around its cavities are `thickness` meters thick, measured from outside.

        Space deeper below the outer side is empty where it is connected with a cavity; parts that are hardly
        thicker than a wall on both sides, like handles, stay solid. Raises SceneError where there is no cavity, and for
        a thickness that is not positive or leaves nothing of the cavity.
        """
        if not 0 < thickness < np.inf:
            raise SceneError.expected("a number of meters above 0", thickness, name="thickness")
        if not self.hollow.any():
            raise SceneError.expected("at least one", got="none", name="cavity", advice="use solid() or as_seen()")
        empty = self._emptied(thickness)
        if empty is None:
            deepest = float(self._depth[self.hollow > 0].max())
            wanted = f"a wall thickness below {deepest:.3g} m, the depth of the cavity"
            raise SceneError.expected(wanted, thickness, name="thickness")
        # Both sides are drawn by themselves, so a wall may be thinner than a cell.
        values = np.minimum(self._signed_depth - np.float32(thickness), -empty)
        grid = Grid(self.grid.lowest - self.grid.spacing, self.grid.spacing, tuple(each + 2 for each in values.shape))
        # Above a lid cells are as far from the wall as below it, up to the grid's edge.
        edge = -max(self.grid.spacing, float(values.max()))
        cavity = self._enclose(np.pad(values, 1, constant_values=edge), grid, faces)
        left = difference(self.solid(faces=faces), cavity)
        if not len(left.faces):
            wanted = "a wall thickness in meters that can be represented"
            raise SceneError.expected(wanted, thickness, name="thickness", advice="choose a thicker one")
        return left

    @cached_property
    def _lids(self) -> Bool[np.ndarray, "x y z"]:
        """Cells inside the outer side at whose surface it only covers a cavity."""
        inside = self.outer > 0
        skin = inside & ~ndimage.binary_erosion(inside)
        adjacent = ndimage.binary_dilation(self.hollow > 0, np.ones((3, 3, 3)))
        lids = skin & ((self.hollow > 0) | (adjacent & (self.seen <= 0)))
        label, _ = ndimage.label(lids, np.ones((3, 3, 3)))
        sizes = np.bincount(label.ravel())
        sizes[0] = 0
        lids = (sizes > 0.02 * lids.sum())[label]
        # A lid need not be flat.
        similar, away, nearest = facing_similarly(self.outer, lids, LID_BLUR * self.diagonal / self.grid.spacing)
        rim = skin & similar & (away <= _LID_GROWTH * np.sqrt(sizes / np.pi)[label[nearest]])
        grown: Bool[np.ndarray, "x y z"] = ndimage.binary_propagation(lids, np.ones((3, 3, 3)), mask=lids | rim)
        return grown

    @cached_property
    def _depth(self) -> Float32[np.ndarray, "x y z"]:
        """Distance from the outer side without its lids, meters."""
        return distance_from(self.outer, self._lids) * np.float32(self.grid.spacing)

    @cached_property
    def _signed_depth(self) -> Float32[np.ndarray, "x y z"]:
        """Distance below the outer side without its lids, meters; negative outside unless a lid is nearer."""
        near = self._depth <= 1.2 * np.abs(self.outer) + 0.5 * self.grid.spacing
        outside = (self.outer <= 0) & near
        return np.where(outside, -self._depth, self._depth)

    def _emptied(self, thickness: float) -> Float32[np.ndarray, "x y z"] | None:
        """Return how far each cell lies from what is emptied, meters; None where nothing is."""
        margin, seen = _MIN_HALF_THICKNESS * self.diagonal, self.hollow > 0
        inside = self.outer > 0
        deep = inside & (self._depth > thickness)
        label, _ = ndimage.label(inside & (self._depth > thickness + margin))
        joined = np.unique(label[ndimage.binary_dilation(seen) & (label > 0)])
        # A lid covers nothing but a cavity, shallow parts along its rim too.
        start = ((seen | self._lids) & deep) | np.isin(label, joined[joined > 0])
        if not start.any():
            return None
        away = ndimage.distance_transform_edt(~start).astype(np.float32) * np.float32(self.grid.spacing)
        return away - np.float32(1.2 * margin)

    def _enclose(self, values: Float32[np.ndarray, "x y z"], grid: Grid, faces: int) -> Surface:
        smooth = ndimage.gaussian_filter(values, _BLUR_CELLS)
        # Triangles without area, where the surface passes through the middle of a cell, pinch coarser ones.
        least = np.float32(0.02 * grid.spacing)
        smooth = np.where(smooth > 0, np.maximum(smooth, least), np.minimum(smooth, -least))
        return enclose(smooth, grid, faces)

    def describe(self) -> str:
        """Return sentences on the shape: its cavities, what no view saw, and masks that were left out."""
        count = int(self.hollow.max())
        cavities = f"{count or 'no'} {'cavities' if count > 1 else 'cavity'}"
        parts = [f"{cavities}{', supposed behind faces that no outline touches' if self.supposed and count else ''}"]
        if self.report.unseen > 0:
            parts.append(f"{self.report.unseen:.0%} of the surface was seen by no view and is closed")
        if abs(self.report.mask_offset) >= _MIN_REPORTED_PIXELS:
            way = "inwards" if self.report.mask_offset > 0 else "outwards"
            parts.append(f"outlines of masks moved {way} by {abs(self.report.mask_offset):.1f} pixels")
        if self.report.rejected:
            parts.append(f"masks left out, which contradict the others: {', '.join(self.report.rejected)}")
        return "; ".join(parts)

    def digest(self) -> str:
        """Return a digest of all that decides the surfaces: the values, and the code that draws them."""
        code = source_digest(__name__)
        return content_digest(code, self.grid, self.supposed, self.diagonal, self.outer, self.seen, self.hollow)


def facing_similarly(
    outer: Float32[np.ndarray, "x y z"], part: Bool[np.ndarray, "x y z"], blur: float
) -> tuple[Bool[np.ndarray, "x y z"], Float64[np.ndarray, "x y z"], tuple[Int[np.ndarray, "x y z"], ...]]:
    """Return which cells face the way that the nearest of a part of them do, and the distance and indices of that.

    Directions of the part are averaged with a Gaussian of the standard deviation `blur`. All lengths are in cells.
    """
    slopes = np.stack([-each for each in np.gradient(ndimage.gaussian_filter(outer, 1.5))], axis=-1)
    slopes /= np.maximum(np.linalg.norm(slopes, axis=-1, keepdims=True), 1e-12)
    normals = ndimage.gaussian_filter(np.where(part[..., None], slopes, 0.0), (blur, blur, blur, 0.0))
    away, indices = ndimage.distance_transform_edt(~part, return_indices=True)
    nearest = tuple(indices)
    along, length = (slopes * normals[nearest]).sum(axis=-1), np.linalg.norm(normals, axis=-1)[nearest]
    return along > _MIN_LID_COSINE * length, away, nearest
