"""Whether contacts, mesh, photographs and Gaussians show one object in one frame."""

import warnings
from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy import ndimage
from torch import Tensor

from avmsf.capture.placement import FACTORS, WRONG_ROWS, check_placement
from avmsf.capture.settings import CaptureSettings, unit_named
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface
from avmsf.photographs.cameras import View
from avmsf.photographs.visual_hull import Votes, carve
from avmsf.pipeline.views import spread_views

MAX_VIEWS = 12
"""Views that are compared, as far apart as they stand."""
LONGEST = 256
"""Pixels of the longer side of photographs that are compared."""
MASK_PIXELS = 2.0
"""Pixels of a photograph by which its mask's edge may be wrong."""
SAME_SHAPE = 0.3
"""Difference of boxes below which a change of unit explains a greater one: units differ by 3.28 times and more."""


def expect_mesh_in_views(surface: Surface, views: Sequence[View], settings: CaptureSettings) -> None:
    """Raise CaptureError where a mesh and the cameras of photographs are in different units.

    Nothing made of the photographs would lie on the mesh then. The error's `value` is the factor on the mesh by which
    it appears as large as the masks; `settings` are those that both were read by. Views without masks say nothing.
    """
    chosen, points = _masked(views), surface.vertices.double()
    if not chosen or not len(surface.faces):
        return
    found = _box_difference(points, chosen)
    others = {each: _box_difference(each * points, chosen) for each in FACTORS if each != 1}
    factor = min(others, key=others.__getitem__)
    if others[factor] < min(SAME_SHAPE, 0.5 * found):
        raise CaptureError(
            f"expected the mesh and the cameras in one unit; the mesh appears as large as the photographs' masks when "
            f"multiplied by {factor:.4g}; {_mending(factor, settings)}",
            name="surface_unit",
            value=factor,
        )


def _box_difference(points: Float64[Tensor, "points 3"], views: Sequence[View]) -> float:
    """Return the part of both boxes in an image that the points' and the mask's do not share; the median over views."""
    found = []
    for view in views:
        pixels, _ = view.camera.project(points)
        mask, edges = np.argwhere(view.foreground)[:, ::-1], (view.camera.width, view.camera.height)
        if not bool(torch.isfinite(pixels).all()):
            found.append(1.0)
            continue
        seen = np.clip([pixels.amin(0).numpy(), pixels.amax(0).numpy()], 0, edges)
        boxes = np.stack([seen, [mask.min(0), mask.max(0) + 1]])
        shared = np.clip(boxes[:, 1].min(0) - boxes[:, 0].max(0), 0, None).prod()
        found.append(1 - shared / ((boxes[:, 1] - boxes[:, 0]).prod(axis=1).sum() - shared))
    return float(np.median(found))


def expect_contacts_in_views(
    contacts: Float[Tensor, "contacts 3"],
    views: Sequence[View],
    settings: CaptureSettings,
) -> None:
    """Raise CaptureError where cameras see the object elsewhere than the contacts (m) lie.

    Masks of one object have a common volume, the hull, and contacts on it lie inside its mask in every view. Where most
    do not in the median view, a unit is the mistake if nearly all do once it is undone; of several the largest, for
    contacts that are shrunk enough lie inside whatever they were. Views without masks say nothing.
    """
    chosen = _masked(views)
    if not chosen:
        return
    if 2 * _share_inside(contacts, chosen) > 1:
        return
    factor = max((each for each in FACTORS if _share_inside(each * contacts, chosen) >= 1 - WRONG_ROWS), default=1.0)
    hull = carve([view.foreground for view in chosen], [view.camera for view in chosen])
    placement = None if hull is None else check_placement(contacts, _surface_of(hull))
    name = unit_named(factor * settings.meters)
    changed = f'write unit = "{name}" in capture.toml' if name else "scale the contacts or the cameras"
    reason = f"and inside when multiplied by {factor:.4g}; {changed}"
    if factor == 1:
        apart = "and the masks have no common volume: check the poses of the cameras"
        reason = apart if placement is None else placement.describe(what="masks' hull")
    raise CaptureError(
        f"expected contacts on the object in the photographs, got most outside of its outlines, {reason}",
        name="unit" if factor != 1 else "frame",
        value=factor,
    )


def expect_on_object(
    contacts: Float[Tensor, "contacts 3"],
    points: Float[Tensor, "points 3"],
    *,
    names: Sequence[str],
    what: str = "surface",
    strict: bool = False,
) -> None:
    """Warn with `CaptureWarning` of contacts off `what` the object's points are, with the mistake that may explain it.

    Raises `CaptureError` for contacts in another frame, for one farther off than the object is large, and, if `strict`,
    for any off it. The `value` of both is the largest distance, meters.
    """
    placement = check_placement(contacts, points)
    words, distance = placement.describe(names, what=what), float(placement.distances.max())
    apart = placement.fault in ("frame", "unit") or distance > placement.diagonal
    if words and (apart or (strict and placement.off)):
        raise CaptureError(words, name="contacts", value=distance)
    if words:
        warnings.warn(CaptureWarning(words, name="contacts", value=distance), stacklevel=2)


def _surface_of(hull: Votes) -> Float[Tensor, "places 3"]:
    """Return the middles of the outermost cubes that are object, float64."""
    occupied = np.pad(hull.occupied(missing=hull.views // 6), 1)
    edge = occupied & ~ndimage.binary_erosion(occupied)
    return torch.from_numpy(hull.grid.centers(np.argwhere(edge) - 1))


def _masked(views: Sequence[View]) -> Sequence[View]:
    """Return views with masks that show something, `MAX_VIEWS` at most, as far apart as they stand."""
    return spread_views([view for view in views if view.foreground.any()], MAX_VIEWS)


def _share_inside(contacts: Float[Tensor, "contacts 3"], views: Sequence[View]) -> float:
    """Return the part of the contacts that lies inside the mask, or within `MASK_PIXELS`; the median over views."""
    found = []
    reach = round(MASK_PIXELS)
    for view in views:
        assert view.mask is not None
        mask = cv2.dilate(view.mask.numpy(), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 127
        pixels, _ = view.camera.project(contacts)
        column, row = pixels[view.camera.contains(pixels)].long().T.numpy()
        found.append(float(mask[row, column].sum()) / len(contacts))
    return float(np.median(found))


def _mending(factor: float, settings: CaptureSettings) -> str:
    """Return what to write in capture.toml where the mesh times a factor fits the cameras."""
    views, contacts = unit_named(settings.views_meters / factor), unit_named(settings.meters * factor)
    if views is not None:
        return f'write views_unit = "{views}" in capture.toml'
    mesh = unit_named(settings.surface_meters * factor)
    if contacts is not None and mesh is not None:
        return f'write unit = "{contacts}" and surface_unit = "{mesh}" in capture.toml'
    return "scale the cameras or the mesh"
