"""What shows the object in a folder, and the stages that make views with cameras and masks of it, whatever it is."""

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch

from avmsf.capture.filenames import SPLATS, VIDEO_SUFFIXES, find_surface_file, pictures_in
from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError, SceneError
from avmsf.mesh.points import farthest_points
from avmsf.mesh.textured_mesh import images_of_library, libraries_of, read_textured_mesh
from avmsf.photographs import find_foreground, read_views
from avmsf.photographs.cameras import MIN_VIEWS, View
from avmsf.photographs.colmap import find_model
from avmsf.photographs.folder import read_camera_file, write_views
from avmsf.photographs.mesh_views import orbit_cameras, render_views
from avmsf.photographs.nerf_json import points_file
from avmsf.photographs.sfm import estimate_cameras
from avmsf.photographs.video import pick_frames
from avmsf.pipeline.config import ViewsConfig
from avmsf.pipeline.stages import Stage, digest_files

Kind = Literal["cameras", "photographs", "video", "mesh"]
Log = Callable[[str], None]
MOTION, VIEWS = "motion", "views"
"""What the stages call their outputs."""


@dataclass(frozen=True)
class Source:
    """What a folder's views are made of."""

    kind: Kind
    files: tuple[Path, ...]
    """Files that decide the views, but for those elsewhere that a camera file names."""
    path: Path
    """Folder of cameras or photographs, or the video or the mesh itself."""
    folder: Path
    """The folder that holds all of it."""

    @cached_property
    def digest(self) -> str:
        """Of all that decides the views."""
        named = _named_by_cameras(self.folder) if self.kind == "cameras" else []
        return digest_files((*self.files, *named), root=self.folder)


def find_source(folder: Path, settings: CaptureSettings, *, prefer: Literal["best", "mesh"] = "best") -> Source | None:
    """Return what the folder's views can be made of, best first; None where it holds nothing of the kind.

    Photographs with cameras (transforms.json or a COLMAP model) go before a mesh, whose frame is the contacts' as well,
    unless the mesh is preferred; a mesh before photographs alone, and these before a video, whose cameras are found in
    a frame of their own. Raises SceneError for more than one video, and for one or two photographs alone.
    """
    if not folder.is_dir():
        raise SceneError.expected("a folder with photographs, a video or a mesh", file=folder, advice="check the name")
    transforms = folder / "transforms.json"
    model = None if transforms.is_file() else find_model(folder)
    photographs = folder / "images" if (folder / "images").is_dir() else folder
    images, masks = pictures_in(photographs, deep=photographs != folder), pictures_in(folder / "masks", deep=True)
    surface = find_surface_file(folder, settings)
    shaped = surface is not None and surface.is_file()
    if (model is not None or transforms.is_file()) and not (prefer == "mesh" and shaped):
        parts = [transforms] if model is None else [each for each in model.iterdir() if each.is_file()]
        return Source("cameras", (*parts, *images, *masks), folder, folder)
    if surface is not None and shaped:
        libraries = libraries_of(surface)
        textures = [path for each in libraries for path in images_of_library(each).values() if path.is_file()]
        companions = (*pictures_in(surface.parent, deep=False), *libraries, *textures)
        return Source("mesh", (surface, *companions), surface, folder)
    if len(images) >= MIN_VIEWS or (images and photographs != folder):
        if len(images) < MIN_VIEWS:
            raise SceneError.expected(
                f"{MIN_VIEWS} photographs or more", len(images), file=photographs, advice="take more"
            )
        return Source("photographs", (*images, *masks), photographs, folder)
    videos = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
    if len(videos) > 1:
        names = [path.name for path in videos]
        raise SceneError.expected(
            "one video of the object", names, got=", ".join(names), file=folder, advice="remove the others"
        )
    return Source("video", tuple(videos), videos[0], folder) if videos else None


def _named_by_cameras(folder: Path) -> list[Path]:
    """Return the photographs, masks and points that the camera file names, wherever they are."""
    # Where it cannot be read, who reads the views says why.
    with suppress(CaptureError):
        found = read_camera_file(folder)
        named = [path for each in found.photographs for path in (each.image, each.mask)]
        named.append(points_file(found.path) if found.path.suffix == ".json" else None)
        return [path for path in named if path is not None and path.is_file()]
    return []


def find_splats(folder: Path) -> Path | None:
    """Return the file of Gaussians in the folder, where there is one."""
    return next((folder / name for name in SPLATS if (folder / name).is_file()), None)


def view_stages(source: Source, config: ViewsConfig, *, settings: CaptureSettings, log: Log) -> list[Stage]:
    """Return the stages that make the folder `views` of a source's views, with masks.

    Photographs without cameras get them by structure from motion first, in the folder `motion`, which holds `images`
    and the COLMAP model `sparse/0`. Raise as the readers do.
    """

    def find_cameras(path: Path) -> None:
        shutil.rmtree(path, ignore_errors=True)
        if source.kind == "video":
            log(f"views: picking {config.frames} frames of {source.path.name}")
            pick_frames(source.path, path / "images", count=config.frames)
        else:
            _copy_photographs(source, path)
        log("views: finding the cameras by structure from motion")
        estimate_cameras(path / "images", path, timeout=60 * config.minutes, seed=config.seed)

    def make_views(path: Path, motion: Path | None = None) -> None:
        if source.kind == "mesh":
            mesh = read_textured_mesh(source.path, meters=settings.surface_meters)
            cameras = orbit_cameras(mesh.surface, size=config.rendered)
            log(f"views: rendering {len(cameras)} of {source.path.name}")
            views = render_views(mesh, cameras)
        else:
            views = read_views(motion or source.path, longest=config.longest, meters=settings.views_meters)
            bare = sum(view.mask is None for view in views)
            if config.masks and bare:
                log(f"views: {len(views)}, finding the object in {bare} without a mask")
                views = find_foreground(views)
        write_views(spread_views(views, config.count), path, replace=True)

    def recipe() -> dict[str, Any]:
        names = ("rendered", "count") if source.kind == "mesh" else ("longest", "masks", "count")
        lengths = {"views_meters": settings.views_meters, "surface_meters": settings.surface_meters}
        return {"kind": source.kind, **lengths, **{name: getattr(config, name) for name in names}}

    if source.kind not in ("photographs", "video"):
        return [Stage(VIEWS, make_views, recipe=lambda: {"files": source.digest, **recipe()})]
    frames = {"frames": config.frames} if source.kind == "video" else {}
    motion = Stage(MOTION, find_cameras, recipe=lambda: {"files": source.digest, "seed": config.seed, **frames})
    return [motion, Stage(VIEWS, make_views, (MOTION,), recipe)]


def _copy_photographs(source: Source, folder: Path) -> None:
    """Copy photographs and their masks to `images` and `masks` in a folder."""
    masks = source.folder / "masks"
    for file in source.files:
        masked = file.is_relative_to(masks)
        place = folder / ("masks" if masked else "images") / file.relative_to(masks if masked else source.path)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, place)


def spread_views(views: Sequence[View], count: int) -> Sequence[View]:
    """Return at most `count` views whose cameras are farthest apart, in the order of all; all for 0."""
    if not 0 < count < len(views):
        return views
    positions = torch.stack([view.camera.position for view in views])
    return [views[row] for row in sorted(farthest_points(positions, count).tolist())]
