"""Checks of what shows the object: its names and camera files, and whether it and the contacts are in one frame."""

import importlib.util
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float64
from PIL import Image
from scipy import ndimage
from torch import Tensor

from avmsf._utils.text import counted, listed
from avmsf.capture.checks import find_surface, readable_impacts, units_by, units_words
from avmsf.capture.filenames import find_surface_file, pictures_in, unused_files
from avmsf.capture.folder import Capture
from avmsf.capture.placement import FACTORS, WRONG_ROWS, check_placement, expect_placed
from avmsf.capture.proposals import contacts_of
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.errors import AvmsfError, AvmsfWarning, CaptureError, CaptureWarning, SceneError
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.surface import Surface
from avmsf.photographs.cameras import View
from avmsf.photographs.folder import mask_paths, read_camera_file, read_views
from avmsf.photographs.segmentation import find_foreground
from avmsf.photographs.visual_hull import carve
from avmsf.pipeline.scene import scaled, without_far
from avmsf.pipeline.views import find_source, find_splats, spread_views

MAX_VIEWS = 12
"""Views that are compared, as far apart as they stand."""
LONGEST = 256
"""Pixels of the longer side of photographs that are compared."""
MASK_PIXELS = 2.0
"""Pixels of a photograph by which its mask's edge may be wrong."""
WITHOUT_SHAPE = "; or fit a field of the positions alone by --without-shape"
SAME_SHAPE = 0.3
"""Difference of boxes below which a change of unit explains a greater one: units differ by 3.28 times and more."""


@dataclass(frozen=True)
class VisualInputs:
    """What in a folder shows the object, in plain values."""

    photographs: int
    cameras: str | None
    """The file or folder with the cameras of the photographs; None where they have none."""
    masks: int
    """Photographs with a mask: a file of its own, or an alpha channel."""
    video: str | None
    mesh: str | None
    gaussians: str | None
    problems: tuple[str, ...]
    """What is wrong with these, as far as names and camera files show it."""
    unused: tuple[str, ...] = ()
    """Sentences on files that look like a shape, pictures or cameras and are not used."""

    @property
    def reconstructs(self) -> bool:
        """Whether the object's shape is reconstructed, since there is no mesh."""
        return self.mesh is None and bool(self.photographs or self.video or self.gaussians)

    @property
    def sentence(self) -> str:
        """The line on what shows the object."""
        found = []
        if self.photographs:
            cameras = "without cameras" if self.cameras is None else f"with cameras ({self.cameras})"
            some = self.masks < self.photographs
            masks = "no masks" if not self.masks else f"masks of {self.masks}" if some else "masks"
            found.append(f"{counted(self.photographs, 'photograph')} {cameras}, {masks}")
        named = {"video": self.video, "mesh": self.mesh, "Gaussians": self.gaussians}
        found += [f"{kind} {name}" for kind, name in named.items() if name is not None]
        return f"the object is shown by: {'; '.join(found) or 'no photographs, video, mesh or Gaussians'}"


def inputs(folder: Path, settings: CaptureSettings | None = None) -> VisualInputs | None:
    """Return what in a folder shows the object; None for a folder or settings that cannot be read."""
    try:
        settings = settings or settings_of(folder)
        surface = find_surface_file(folder, settings)
        if not folder.is_dir():
            return None
    except CaptureError:
        return None
    problems, kind, video = list[str](), None, None
    try:
        source = find_source(folder, settings)
        if source is not None:
            kind, video = source.kind, source.path.name if source.kind == "video" else None
    except SceneError as error:
        problems.append(str(error))
    names, cameras, masks = _photographs(folder, kind, problems)
    masked = _masked(folder, names, masks, problems)
    if kind == "photographs" and importlib.util.find_spec("pycolmap") is None:
        problems.append(
            "the photographs have no cameras, and the package that finds them is missing: pip install 'avmsf[sfm]'"
        )
    splats = find_splats(folder)
    return VisualInputs(
        len(names),
        cameras,
        masked,
        video,
        None if surface is None or not surface.is_file() else surface.name,
        None if splats is None else splats.name,
        tuple(problems),
        tuple(unused_files(folder, settings)),
    )


def expect_shape(capture: Capture) -> None:
    """Raise SceneError where nothing reads what in a capture's folder was meant to show the object."""
    folder = capture.folder
    visual = None if folder is None or capture.surface is not None else inputs(folder, capture.settings)
    if visual is not None and not visual.reconstructs and visual.unused:
        raise SceneError(
            f"{folder}: expected the object's shape, got none; {'; '.join(visual.unused[:3])}{WITHOUT_SHAPE}",
            file=folder,
            name="shape",
            value=visual.unused,
        )


def misplaced(folder: Path, visual: VisualInputs) -> list[AvmsfWarning | AvmsfError]:
    """Return what `avmsf fit` would warn of or raise of cameras, masks, Gaussians and contacts together.

    It opens some of the photographs, at a low resolution.
    """
    settings = settings_of(folder)
    impacts = readable_impacts(folder, settings)
    if not impacts:
        return []
    contacts, names = contacts_of(impacts), [each.file for each in impacts]
    found = list[AvmsfWarning | AvmsfError]()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CaptureWarning)
        try:
            if visual.cameras is not None:
                views = read_views(folder, longest=LONGEST, max_views=MAX_VIEWS, meters=settings.views_meters)
                views = find_foreground(views)
                surface = None if visual.mesh is None else find_surface(folder, settings)
                if surface is not None:
                    expect_mesh_in_views(surface, views, settings)
                expect_contacts_in_views(contacts, views, settings)
            if visual.gaussians is not None:
                cloud = without_far(scaled(read_splats(folder / visual.gaussians), settings.views_meters))
                expect_placed(contacts, cloud.centers, names=names, what="Gaussians")
        except (CaptureError, SceneError) as error:
            found.append(error)
    warned = [each.message for each in caught if isinstance(each.message, CaptureWarning)]
    # Which photographs are missing the camera file's check says.
    return [*(each for each in warned if each.name not in ("missing images", "cameras")), *found]


def _photographs(
    folder: Path, kind: str | None, problems: list[str]
) -> tuple[dict[str, Path], str | None, dict[str, Path]]:
    """Return the photographs by their names, what holds their cameras, and the masks that it names.

    Pictures next to a mesh may be its textures: without a camera file they count where nothing else shows the object.
    """
    if kind == "cameras":
        try:
            found = read_camera_file(folder)
        except CaptureError as error:
            problems.append(str(error))
            return _photographs(folder, "photographs", problems)
        missing = [each.name for each in found.photographs if not each.image.is_file()]
        if missing:
            lacks = counted(len(missing), "missing photograph")
            problems.append(f"{found.path.name}: {lacks}, {listed(missing)}; copy them there")
        present = {each.name: each.image for each in found.photographs if each.image.is_file()}
        origin = "COLMAP's" if found.path == folder else found.path.relative_to(folder).as_posix()
        return present, origin, {each.name: each.mask for each in found.photographs if each.mask is not None}
    images = folder / "images"
    if images.is_dir():
        return {path.relative_to(images).as_posix(): path for path in pictures_in(images, deep=True)}, None, {}
    alone = pictures_in(folder, deep=False) if kind == "photographs" else []
    return {path.name: path for path in alone}, None, {}


def _masked(folder: Path, names: dict[str, Path], masks: dict[str, Path], problems: list[str]) -> int:
    """Return how many photographs have a mask; add to `problems` masks of no photograph, and masks that are missing."""
    places = {name: [*mask_paths(name, folder), *([masks[name]] if name in masks else [])] for name in names}
    known = {path for each in places.values() for path in each}
    unmatched = [path for path in pictures_in(folder / "masks", deep=True) if path not in known]
    if unmatched:
        shown = listed([path.relative_to(folder).as_posix() for path in unmatched])
        problems.append(
            f"{counted(len(unmatched), 'mask')} without a photograph of that name: {shown}; a mask is masks/NAME.png"
        )
    bare = [
        name
        for name, each in places.items()
        if not any(path.is_file() for path in each) and not _has_alpha(names[name])
    ]
    if bare and (masks or len(bare) < len(names)):
        problems.append(f"{counted(len(bare), 'photograph')} without a mask: {listed(bare)}; add masks/NAME.png")
    return len(names) - len(bare)


def _has_alpha(photograph: Path) -> bool:
    """Return whether a photograph has an alpha channel, by its header."""
    try:
        with Image.open(photograph) as picture:
            return "A" in picture.getbands()
    except (OSError, Image.DecompressionBombError):
        return False


def expect_mesh_in_views(surface: Surface, views: Sequence[View], settings: CaptureSettings) -> None:
    """Raise CaptureError where a mesh and the cameras of photographs are in different units.

    Nothing made of the photographs would lie on the mesh then. The error's `value` is the units that mend it;
    `settings` are those that both were read by. Views without masks say nothing.
    """
    chosen, points = _with_masks(views), surface.vertices.double()
    if not chosen or not len(surface.faces):
        return
    found = _box_difference(points, chosen)
    others = {each: _box_difference(each * points, chosen) for each in FACTORS if each != 1}
    factor = min(others, key=others.__getitem__)
    if others[factor] < min(SAME_SHAPE, 0.5 * found):
        size = factor * float((points.amax(0) - points.amin(0)).norm())
        units = units_by(settings, size, {"unit": factor, "surface_unit": factor, "views_unit": 1.0})
        raise CaptureError(
            f"expected the mesh and the cameras in one unit; the mesh appears as large as the photographs' masks when "
            f"multiplied by {factor:.4g}; {units_words(units) or 'scale the cameras or the mesh'}",
            name="surface_unit",
            value=units,
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
    contacts: Float[Tensor, "contacts 3"], views: Sequence[View], settings: CaptureSettings
) -> None:
    """Raise CaptureError where cameras see the object elsewhere than the contacts (m) lie.

    Masks of one object have a common volume, the hull, and contacts on it lie inside its mask in every view. Where most
    do not in the median view, a unit is the mistake if nearly all do once it is undone; of several the largest, for
    contacts that are shrunk enough lie inside whatever they were. The error's `value` is the units that mend it. Views
    without masks say nothing.
    """
    chosen = _with_masks(views)
    if not chosen:
        return
    if 2 * _share_inside(contacts, chosen) > 1:
        return
    factor = max((each for each in FACTORS if _share_inside(each * contacts, chosen) >= 1 - WRONG_ROWS), default=1.0)
    size = factor * float((contacts.amax(0) - contacts.amin(0)).norm())
    units = {} if factor == 1 else units_by(settings, size, {"unit": factor, "views_unit": 1.0})
    reason = f"and inside when multiplied by {factor:.4g}; {units_words(units) or 'scale the contacts or the cameras'}"
    if factor == 1:
        hull = carve([view.foreground for view in chosen], [view.camera for view in chosen])
        reason = "and the masks have no common volume: check the poses of the cameras"
        if hull is not None:
            occupied = np.pad(hull.occupied(missing=hull.views // 6), 1)
            edge = np.argwhere(occupied & ~ndimage.binary_erosion(occupied)) - 1
            placement = check_placement(contacts, torch.from_numpy(hull.grid.centers(edge)))
            reason = placement.describe(what="masks' hull")
    raise CaptureError(
        f"expected contacts on the object in the photographs, got most outside of its outlines, {reason}",
        name="unit" if factor != 1 else "frame",
        value=units,
    )


def _with_masks(views: Sequence[View]) -> Sequence[View]:
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
