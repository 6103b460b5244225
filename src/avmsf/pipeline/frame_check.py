"""Whether contacts, mesh, photographs and Gaussians show one object in one frame."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from avmsf.capture.placement import FACTORS, WRONG_ROWS, check_placement
from avmsf.capture.settings import CaptureSettings, unit_named
from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.surface import Surface
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.folder import check_cameras
from avmsf.photographs.mesh_views import MeshTracer
from avmsf.photographs.visual_hull import Votes, carve
from avmsf.pipeline.views import spread_views

MAX_VIEWS = 12
"""Views that are compared, as far apart as they stand."""
LONGEST, COARSE = 256, 64
"""Pixels of the longer side of what is compared, and of what units are tried by."""
MASK_PIXELS = 2.0
"""Pixels of a photograph by which its mask's edge may be wrong."""
BEYOND = 0.005
"""Part of an outline's area that may differ beyond that: thin parts, which masks lose."""
SAME_SHAPE = 0.3
"""Difference of outlines below which a change of unit explains a greater one. A ball beside a cube of its size has
.2."""


@dataclass(frozen=True)
class OutlineDifference:
    """How a mesh's outlines differ from masks, medians over the views, so that single wrong masks do not matter."""

    difference: float
    """Area that only one of them has over the area that at least one has: 0 to 1."""
    beyond: float
    """Likewise, without what lies within `MASK_PIXELS` of the mask's edge."""
    size: float
    """Square root of the outline's area over the mask's."""


def compare_outlines(
    tracer: MeshTracer, views: Sequence[View], *, longest: int = LONGEST, factor: float = 1.0
) -> OutlineDifference:
    """Compare a mesh, times a factor, with the masks of views, which all have one that shows something."""
    found = []
    for view in views:
        assert view.mask is not None
        scale = min(1.0, longest / max(view.camera.width, view.camera.height))
        width, height = max(1, round(scale * view.camera.width)), max(1, round(scale * view.camera.height))
        camera = _scaled(view.camera.resized(width, height), 1.0 / factor)
        outline = torch.isfinite(tracer.depth(camera)).numpy()
        mask = cv2.resize(view.mask.numpy(), (width, height), interpolation=cv2.INTER_AREA) > 127
        either, differs = outline | mask, outline ^ mask
        # Each pixel's distance to the nearest one on the other side of the mask's edge.
        sides = (each.astype(np.uint8) for each in (mask, ~mask))
        far = sum(cv2.distanceTransform(each, cv2.DIST_L2, 5) for each in sides) > 1.0 + MASK_PIXELS * scale
        area = max(1, int(either.sum()))
        found.append((differs.sum() / area, (differs & far).sum() / area, (outline.sum() / max(1, mask.sum())) ** 0.5))
    return OutlineDifference(*np.median(np.array(found), axis=0).tolist())


def check_outlines(surface: Surface, views: Sequence[View], settings: CaptureSettings) -> CaptureWarning | None:
    """Return a warning for a mesh that differs from the masks of photographs by more than their accuracy.

    Its `value` is the difference as a part of the area. None where they agree, and where no view has a mask; `settings`
    are those that both were read by. Raises CaptureError where cameras and mesh are in different units, with the factor
    on the mesh that fits as `value`: nothing made of the photographs would lie on the mesh.
    """
    chosen = _masked(views)
    if not chosen or not len(surface.faces):
        return None
    tracer = MeshTracer(surface)
    found = compare_outlines(tracer, chosen)
    if found.beyond <= BEYOND:
        return None
    words = f"the mesh's outlines and the photographs' masks differ by {_percent(found.difference)} of their area"
    if found.difference > SAME_SHAPE:
        factor, best = min(
            ((each, compare_outlines(tracer, chosen, longest=COARSE, factor=each)) for each in FACTORS if each != 1),
            key=lambda pair: pair[1].difference,
        )
        if best.difference < min(SAME_SHAPE, 0.5 * found.difference):
            raise CaptureError(
                f"expected the mesh and the cameras in one unit; {words}, and by {_percent(best.difference)} with the "
                f"mesh times {factor:.4g}; {_mending(factor, settings)}",
                name="surface_unit",
                value=factor,
            )
    size = f"{_percent(abs(found.size - 1))} {'larger' if found.size > 1 else 'smaller'}"
    return CaptureWarning(
        f"{words}, {_percent(found.beyond)} beyond {MASK_PIXELS:g} pixels of the masks' edges, and the mesh is {size}; "
        "check that both are of one object, in one unit and frame (the mesh is used as the object's shape)",
        name="surface",
        value=found.difference,
    )


def expect_contacts_in_views(
    contacts: Float[Tensor, "contacts 3"],
    views: Sequence[View],
    settings: CaptureSettings,
) -> None:
    """Raise CaptureError where cameras do not see one object, or see it elsewhere than the contacts (m) lie.

    Masks of one object have a common volume, the hull, and contacts on it lie inside its mask in every view. Where most
    do not in the median view, a unit is the mistake if nearly all do once it is undone; of several the largest, for
    contacts that are shrunk enough lie inside whatever they were. Views without masks say nothing.
    """
    chosen = _masked(views)
    if not chosen:
        return
    hull = _hull(chosen)
    if hull is None:
        shares = {
            words: _share_inside(contacts, changed) * bool(_hull(changed)) for words, changed in _conventions(chosen)
        }
        likely = max(shares, key=shares.__getitem__)
        found = list(map(str, check_cameras([view.camera for view in chosen])))
        found += [f"they show the contacts once {likely}"] if 2 * shares[likely] > 1 else []
        # Cubes may miss what is thin: by itself that says nothing.
        if found:
            raise CaptureError(
                f"expected cameras that look at one object, got masks without a common volume: {'; '.join(found)}",
                name="cameras",
                value=len(chosen),
            )
    if 2 * _share_inside(contacts, chosen) > 1:
        return
    factor = max((each for each in FACTORS if _share_inside(each * contacts, chosen) >= 1 - WRONG_ROWS), default=1.0)
    placement = None if hull is None else check_placement(contacts, _surface_of(hull))
    name = unit_named(factor * settings.meters)
    changed = f'write unit = "{name}" in capture.toml' if name else "scale the contacts or the cameras"
    reason = f"and inside when multiplied by {factor:.4g}; {changed}"
    if factor == 1:
        reason = "and no change of unit explains it" if placement is None else placement.describe(what="masks' hull")
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


def _hull(views: Sequence[View]) -> Votes | None:
    return carve([view.foreground for view in views], [view.camera for view in views])


def _conventions(views: Sequence[View]) -> Iterator[tuple[str, list[View]]]:
    """Yield views with cameras as they would be were their poses of another convention, and what would mend these."""
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    ways: dict[str, Callable[[Tensor], Tensor]] = {
        "the second and third column of each pose are negated (OpenCV's axes for OpenGL's)": lambda pose: turn @ pose,
        "each pose is inverted (world to camera for camera to world)": lambda pose: turn @ pose.inverse() @ turn,
        "each pose is inverted, its second and third column then negated": lambda pose: pose.inverse() @ turn,
    }
    for words, way in ways.items():
        cameras = [replace(view.camera, world_to_camera=way(view.camera.world_to_camera.double())) for view in views]
        yield words, [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]


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


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def _scaled(camera: Camera, factor: float) -> Camera:
    """Return the camera with its distance from the origin times a factor."""
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= factor
    return replace(camera, world_to_camera=pose)
