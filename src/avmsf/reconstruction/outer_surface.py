"""From masks and depth of many views to an object's shape."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int
from scipy import ndimage

from avmsf.errors import SceneError
from avmsf.gaussians.visibility import DepthMap
from avmsf.mesh.level_set import Grid, enclose, touches_edge
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.visual_hull import masked_views, no_common_point, object_extent
from avmsf.reconstruction.depth_fusion import free_space
from avmsf.reconstruction.distance import depth_in_convex_hull
from avmsf.reconstruction.fairing import fair_hull
from avmsf.reconstruction.object_shape import LID_BLUR, ObjectShape, ShapeReport, facing_similarly
from avmsf.reconstruction.outlines import WRONG_FRACTION, Outline, consistent_masks, edge_offset, hull_distance

_COARSE_CELLS = 48
"""Cells along an edge of the first grids, which find where the object is and which masks are wrong."""
_MAX_REFINEMENT = 4.0
"""Times as many cells along the longest side of a slender object, at most."""
_MARGIN_CELLS = 4
"""Cells of free room around the hull."""
_DEPTH_TOLERANCE = 0.005
"""How far depth must lie behind the hull to be believed, over the diagonal: its mean over views is so exact."""
_CLOSING_FACES = 4000
"""Triangles of the surface whose convex hull closes what no view sees."""
_MIN_HALF_WIDTH_CELLS = 2
"""Half the width of hollows that are none, cells."""
_MIN_TOUCH_DISTANCE = 0.025
"""Distance from the nearest touch of an outline, over the diagonal, from which on a point is inside a face of which
outlines tell the edge alone. Touches on round parts are three pixels apart."""
_MIN_AREA_RATIO = 0.7
"""Area of such a face over that of the largest, from which on both are openings or neither: the ends of a tube."""
_MIN_FACE_RATIO = 0.02
"""Part of the surface that a face must be for a supposed opening."""
_LINES_PER_VIEW = 64
"""Lines through openings that are followed, about."""
_MIN_CAVITY_DEPTH = 0.08
"""Depth below its lid, over the diagonal, from which on what is free is a cavity."""
_MIN_CAVITY_VOLUME = 0.08
"""Part of the filled volume from which on it is a cavity although it is shallow: plates."""


def object_surface(views: Sequence[View], depth_map: DepthMap, *, cells: int = 128) -> ObjectShape:
    """Return the shape of the object that views with masks show, and whose depth `depth_map` gives.

    `cells` count along the longest side; slender objects have up to four times as many. Views whose masks contradict
    the others' are left out, and all outlines are moved to the edges in the photographs by the same number of pixels.
    Depth may lie behind the surface by the same length everywhere: that is found where the masks' outlines touch the
    surface, and taken off. Raises SceneError where fewer than 3 views have masks, where masks have nothing in
    common, and where views do not bound the object: an image cuts it, or all are from one side.
    """
    if cells < 16:
        raise SceneError.expected("16 or more", cells, name="cells")
    masked = masked_views(views)
    outlines = [Outline.of(view) for view in masked]
    offset = edge_offset(masked, outlines)
    outlines = [outline.moved_in(offset) for outline in outlines]
    rough = Grid.around(*_rough(masked, outlines), cells=_COARSE_CELLS, finest=_MAX_REFINEMENT, margin=2)
    maps = [depth_map(view.camera).detach().cpu().float().numpy() for view in masked]
    right = consistent_masks(masked, outlines, maps, rough)
    kept, outlines, maps = list(compress(masked, right)), list(compress(outlines, right)), list(compress(maps, right))
    low, high = _box(hull_distance(outlines, rough, rank=0) > -rough.spacing, rough, len(kept))
    grid = Grid.around(low, high, cells=cells, finest=_MAX_REFINEMENT, margin=_MARGIN_CELLS)
    hull = _hull(outlines, grid)
    low, high = _box(hull > 0, grid, len(kept))
    diagonal = float(np.linalg.norm(high - low))
    hull, untouched = fair_hull(hull, outlines, grid, diagonal)
    cameras = [view.camera for view in kept]
    # At the outline a pixel's depth is the background's in part.
    depths = [np.where(view.foreground, depth, np.float32(0.0)) for view, depth in zip(kept, maps, strict=True)]
    free, view_counts = free_space(depths, cameras, hull, grid, diagonal)
    seen = np.minimum(hull, _DEPTH_TOLERANCE * diagonal - free)
    seen, bound, unseen = _closed(hull, seen, view_counts, grid)
    hollow = _hollows(bound, seen, grid, diagonal)
    supposed = not hollow.any()
    # Beside cavities that were seen, what depth carves is its scatter.
    outer = seen if supposed else bound
    hollow = _opened(hollow, outer, untouched > _MIN_TOUCH_DISTANCE * diagonal, LID_BLUR * diagonal / grid.spacing)
    rejected = tuple(view.name for view, each in zip(masked, right, strict=True) if not each)
    shape = ObjectShape(grid, outer, seen, hollow, supposed, diagonal, ShapeReport(rejected, offset, unseen))
    if supposed and _seen_through(hollow, seen > 0, cameras, grid):
        return shape.closed() or replace(shape, hollow=np.zeros_like(hollow))
    return shape


def _rough(
    views: Sequence[View], outlines: Sequence[Outline]
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Return the lowest and highest corner of a box around what all but a few masks keep, meters."""
    middle, reach = object_extent([view.foreground for view in views], [view.camera for view in views])
    for _ in range(5):
        grid = Grid(middle - reach, 2 * reach / (_COARSE_CELLS - 1), (_COARSE_CELLS,) * 3)
        solid = hull_distance(outlines, grid, rank=round(WRONG_FRACTION * len(outlines))) > -grid.spacing
        if not touches_edge(solid):
            return _box(solid, grid, len(views))
        reach *= 1.5
    raise SceneError.expected(
        "views from several sides, whose masks bound the object",
        len(views),
        got=f"{len(views)} whose masks leave it open {reach / 1.5:.3g} m from its middle",
        name="views",
        advice="add views of the complete object from other sides",
    )


def _hull(outlines: Sequence[Outline], grid: Grid) -> Float32[np.ndarray, "x y z"]:
    """Return how far inside the hull each cell lies; far outside it, the distance of a cell of a coarser grid."""
    coarse = grid.coarser(2)
    rough = hull_distance(outlines, coarse, rank=0)
    rough = rough.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
    rough = rough[: grid.shape[0], : grid.shape[1], : grid.shape[2]]
    near = rough > -4 * grid.spacing
    fine = hull_distance(outlines, grid, near, rank=0)
    return np.where(near, fine, rough)


def _box(
    inside: Bool[np.ndarray, "x y z"], grid: Grid, views: int
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Return the lowest and highest corner of the box around what is inside, meters."""
    if not inside.any():
        raise no_common_point(views)
    return grid.box(inside)


def _opened(
    hollow: Int[np.ndarray, "x y z"],
    outer: Float32[np.ndarray, "x y z"],
    untouched: Bool[np.ndarray, "x y z"],
    blur: float,
) -> Int[np.ndarray, "x y z"]:
    """Return the numbers of cavities in all of the faces that they open in, a cell deep.

    No outline touches such a face: outlines do not say whether it is there, or only its edge. Where no view saw into a
    cavity, one is supposed behind each of the largest faces.
    """
    inside = outer > 0
    skin = inside & ~ndimage.binary_erosion(inside)
    label, count = ndimage.label(skin & untouched, np.ones((3, 3, 3)))
    if hollow.any():
        numbers = ndimage.maximum(hollow, label, np.arange(count + 1))
        # Between the touches of few views a face runs over its edge.
        similar, _, nearest = facing_similarly(outer, (hollow > 0) & (label > 0), blur)
        label *= similar & (label == label[nearest])
    else:
        sizes = np.bincount(label[skin], minlength=count + 1)
        sizes[0] = 0
        large = sizes >= max(_MIN_AREA_RATIO * sizes.max(), _MIN_FACE_RATIO * int(skin.sum()))
        numbers = np.where(large, large.cumsum(), 0)
    return np.where((hollow > 0) | (label == 0), hollow, numbers[label]).astype(np.int32)


def _seen_through(
    openings: Int[np.ndarray, "x y z"], inside: Bool[np.ndarray, "x y z"], cameras: Sequence[Camera], grid: Grid
) -> bool:
    """Whether a view through one of the openings would look out through another: its mask would show that."""
    rows = np.argwhere(openings > 0)
    rows = rows[:: max(1, len(rows) // _LINES_PER_VIEW)]
    steps = np.arange(-sum(grid.shape), sum(grid.shape) + 1)[:, None]
    shape = np.array(grid.shape)
    for camera in cameras:
        directions = rows - (camera.position.double().cpu().numpy() - grid.lowest) / grid.spacing
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        cells = np.rint(rows[:, None] + steps * directions[:, None]).astype(int)
        cells[~((cells >= 0) & (cells < shape)).all(2)] = 0
        within = inside[tuple(cells.T)].T
        numbers = openings[tuple(cells.T)].T
        first, last = within.argmax(1), within.shape[1] - 1 - within[:, ::-1].argmax(1)
        line = np.arange(len(rows))
        one, other = numbers[line, first], numbers[line, last]
        if ((within.sum(1) == last - first + 1) & (one > 0) & (other > 0) & (one != other)).any():
            return True
    return False


def _closed(
    hull: Float32[np.ndarray, "x y z"],
    seen: Float32[np.ndarray, "x y z"],
    view_counts: Float32[np.ndarray, "x y z"],
    grid: Grid,
) -> tuple[Float32[np.ndarray, "x y z"], Float32[np.ndarray, "x y z"], float]:
    """Cut what no view sees by the convex hull of what views see.

    Return the cut solid, the hull cut likewise, which lids cavities, and the part of the surface that no view saw.
    """
    surface = enclose(seen, grid, _CLOSING_FACES)
    points = surface.vertices.double().numpy()
    rows = np.rint((points - grid.lowest) / grid.spacing).astype(int)
    known = ndimage.maximum_filter(view_counts, 3)[tuple(rows.T)] >= 1
    if int(known.sum()) < 4:
        advice = "check that depth and views are of one object"
        raise SceneError.expected("a surface in their masks", 0, got="none", name="views", advice=advice)
    near = hull > -2 * grid.spacing
    bound = hull.copy()
    inside = depth_in_convex_hull(points[known], grid.centers(np.argwhere(near)))
    bound[near] = np.minimum(hull[near], inside)
    corners = surface.vertices.double()[surface.faces]
    areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).numpy()
    hidden = ~known[surface.faces.numpy()].any(axis=1)
    return np.minimum(seen, bound), bound, float(areas[hidden].sum() / areas.sum())


def _hollows(
    bound: Float32[np.ndarray, "x y z"], seen: Float32[np.ndarray, "x y z"], grid: Grid, diagonal: float
) -> np.ndarray:
    """Return the number of the cavity that each cell is in, the largest first; 0 in none."""
    free = (bound > 0) & (seen <= 0)
    core = ndimage.distance_transform_edt(free) > _MIN_HALF_WIDTH_CELLS
    opened = free & (ndimage.distance_transform_edt(~core) <= _MIN_HALF_WIDTH_CELLS + 0.5)
    label, count = ndimage.label(opened)
    depth = ndimage.distance_transform_edt(bound > 0)
    total = int((bound > 0).sum())
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    deepest = ndimage.maximum(depth, label, np.arange(count + 1))
    kept = [
        number
        for number in range(1, count + 1)
        if deepest[number] * grid.spacing > _MIN_CAVITY_DEPTH * diagonal or sizes[number] > _MIN_CAVITY_VOLUME * total
    ]
    numbers = np.zeros(count + 1, dtype=np.int32)
    for rank, number in enumerate(sorted(kept, key=lambda each: -int(sizes[each])), start=1):
        numbers[number] = rank
    return numbers[label]
