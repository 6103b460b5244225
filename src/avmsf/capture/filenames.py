"""Names by which the files of a folder are recognized; importing this loads nothing that computes."""

from pathlib import Path
from typing import Literal

from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError, SceneError

SurfaceKind = Literal["ply", "obj", "glb"]
"""Formats that surfaces are written in."""
SURFACE_FILES = ("surface.obj", "surface.ply", "surface.glb", "surface.stl")
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
SPLATS = ("splats.ply", "point_cloud.ply")
"""Names under which a folder may hold Gaussians that were made elsewhere."""
_OF_VIEWS = frozenset(("transforms.json", "images", "sparse", "cameras.bin", "cameras.txt", *SURFACE_FILES, *SPLATS))


def find_surface_file(folder: Path, settings: CaptureSettings) -> Path | None:
    """Return the surface file that the settings name, or the first of the usual names; None where there is none."""
    if settings.surface is not None:
        named = Path(settings.surface)
        if named.is_absolute() or ".." in named.parts:
            raise CaptureError.expected(
                "a file in the capture folder", settings.surface, file=folder, name="surface", advice="copy it there"
            )
        return folder / named
    return next((folder / name for name in SURFACE_FILES if (folder / name).is_file()), None)


def expect_views(folder: Path, settings: CaptureSettings) -> None:
    """Raise `SceneError` for a folder none of whose files, by their names alone, shows the object."""
    if not folder.is_dir():
        raise SceneError.expected("a folder with photographs, a video or a mesh", file=folder, advice="check the name")
    shown = (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES)
    if settings.surface is None and not any(
        path.name in _OF_VIEWS or path.suffix.lower() in shown for path in folder.iterdir()
    ):
        raise no_views(folder)


def no_views(folder: Path) -> SceneError:
    """Return the error of a folder that shows nothing of the object."""
    return SceneError(
        f"{folder}: expected photographs (transforms.json, a COLMAP model or a folder images/), a video, a mesh "
        "(surface.obj, .ply, .glb, .stl) or Gaussians (splats.ply), got none",
        file=folder,
    )
