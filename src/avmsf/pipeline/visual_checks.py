"""Checks of what shows the object in a capture folder: its names and camera files, and whether it fits the contacts."""

import importlib.util
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from avmsf._utils.text import counted, listed
from avmsf.capture.checks import find_surface
from avmsf.capture.filenames import find_surface_file, pictures_in, unused_files
from avmsf.capture.folder import Capture
from avmsf.capture.placement import expect_placed
from avmsf.capture.proposals import contacts_of
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.capture.table import read_rows
from avmsf.errors import AvmsfError, AvmsfWarning, CaptureError, CaptureWarning, FitError, SceneError
from avmsf.gaussians.ply import read_splats
from avmsf.mesh.surface import surface_points
from avmsf.photographs.folder import mask_paths, read_camera_file, read_views
from avmsf.photographs.segmentation import find_foreground
from avmsf.pipeline.frame_check import (
    LONGEST,
    MAX_VIEWS,
    expect_contacts_in_views,
    expect_mesh_in_views,
    expect_on_object,
)
from avmsf.pipeline.scene import scaled, without_far
from avmsf.pipeline.views import find_source, find_splats


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
    """Raise where a capture's folder was meant to show the object and a field would know the positions alone.

    FitError for a surface in another frame than the contacts, SceneError for files that nothing reads.
    """
    advice = "; or fit a field of the positions alone by --without-shape"
    if capture.surface is not None:
        try:
            expect_placed(capture.impacts.contacts, surface_points(capture.surface), names=capture.impacts.names)
        except FitError as error:
            raise FitError(f"{error}{advice}", **error.attributes) from error
        return
    folder = capture.folder
    visual = None if folder is None else inputs(folder, capture.settings)
    if visual is not None and not visual.reconstructs and visual.unused:
        raise SceneError(
            f"{folder}: expected the object's shape, got none; {'; '.join(visual.unused[:3])}{advice}",
            file=folder,
            name="shape",
            value=visual.unused,
        )


def misplaced(folder: Path, visual: VisualInputs) -> list[AvmsfWarning | AvmsfError]:
    """Return what `avmsf fit` would warn of or raise of cameras, masks, Gaussians and contacts together.

    It opens some of the photographs, at a low resolution.
    """
    try:
        settings, rows = settings_of(folder), read_rows(folder)[0]
        contacts = contacts_of(rows, settings)
    except CaptureError:
        return []
    if not len(contacts):
        return []
    names = [row.cells["file"] for row in rows] if len(rows) == len(contacts) else []
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
                expect_on_object(contacts, cloud.centers, names=names, what="Gaussians")
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
