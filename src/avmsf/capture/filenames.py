"""Names by which the files of a folder are recognized; importing this loads nothing that computes."""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

from avmsf.capture.settings import CaptureSettings
from avmsf.errors import CaptureError, SceneError

SHAPE_SUFFIXES = (".obj", ".ply", ".glb", ".stl")
"""Of shapes that are read, the preferred first."""
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
SPLATS = ("splats.ply", "point_cloud.ply")
"""Names under which a folder may hold Gaussians that were made elsewhere."""
_OTHER_NAMES = {
    **dict.fromkeys((".gltf", ".usdz", ".usd", ".fbx", ".dae", ".off", ".3mf", ".gz", ".zip"), "export surface.obj"),
    **dict.fromkeys((".spz", ".splat", ".ksplat", ".sog"), "export the Gaussians as splats.ply"),
    **dict.fromkeys((".heic", ".heif", ".tif", ".tiff", ".dng"), "export it as .jpg"),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "export the table as impacts.csv"),
}
"""Endings of shapes, pictures and tables that are not read, and what to do."""
_OF_VIEWS = frozenset(("transforms.json", "sparse", "cameras.bin", "cameras.txt", *SPLATS))


def files_in(folder: Path, *, deep: bool = True) -> list[Path]:
    """Return the files in a folder, sorted, and `deep` in those beneath it; none where there is no folder.

    Hidden files and folders are left out: a cache in `.avmsf` holds images and recordings of its own.
    """
    paths = folder.rglob("*") if deep else folder.glob("*")
    seen = (path for path in paths if not any(part.startswith(".") for part in path.relative_to(folder).parts))
    return sorted(path for path in seen if path.is_file())


def pictures_in(folder: Path, *, deep: bool) -> list[Path]:
    """Return the image files among `files_in`."""
    return [path for path in files_in(folder, deep=deep) if path.suffix.lower() in PICTURE_SUFFIXES]


def find_surface_file(folder: Path, settings: CaptureSettings) -> Path | None:
    """Return the surface file that the settings name, or the first of the usual names; None where there is none.

    Raises CaptureError for a name outside the folder.
    """
    if settings.surface is not None:
        named = Path(settings.surface)
        if named.is_absolute() or ".." in named.parts:
            wanted, advice = "a file in the capture folder", "copy it there"
            raise CaptureError.expected(wanted, settings.surface, file=folder, name="surface", advice=advice)
        return folder / named
    usual = (folder / f"surface{suffix}" for suffix in SHAPE_SUFFIXES)
    return next((path for path in usual if path.is_file()), None)


def unused_files(folder: Path, settings: CaptureSettings) -> list[str]:
    """Return a sentence for each file that looks like a shape, pictures, cameras or a table and is not used.

    Of many pictures in one folder one sentence is made.
    """
    files = files_in(folder)
    cameras = any(path.name in ("transforms.json", "cameras.bin", "cameras.txt") for path in files)
    surface, advice = find_surface_file(folder, settings), dict[str, str]()
    for path in files:
        name, suffix = path.relative_to(folder).as_posix(), path.suffix.lower()
        top, within = name.partition("/")[0], "/" in name
        if suffix in _OTHER_NAMES:
            advice[name] = _OTHER_NAMES[suffix]
        elif suffix in SHAPE_SUFFIXES and path != surface and top not in ("sparse", *SPLATS):
            gaussians = path.name in SPLATS
            advice[name] = "copy it to splats.ply" if gaussians else f'write surface = "{name}" in capture.toml'
        elif path.name.startswith("transforms_") and suffix == ".json" and not cameras:
            advice[name] = "call it transforms.json"
        elif suffix in PICTURE_SUFFIXES and within and top not in ("images", "masks") and not cameras:
            advice[f"{path.parent.relative_to(folder).as_posix()}/"] = "call the folder of photographs images"
    return [f"{name} is not used: {what}" for name, what in advice.items()]


def shows_object(folder: Path, settings: CaptureSettings) -> bool:
    """Return whether a folder holds anything that shows the object, by the names of its files alone."""
    surface = find_surface_file(folder, settings)
    if (surface is not None and surface.is_file()) or pictures_in(folder / "images", deep=True):
        return True
    shown = (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES)
    return any(path.name in _OF_VIEWS or path.suffix.lower() in shown for path in folder.iterdir())


def expect_views(folder: Path, settings: CaptureSettings) -> None:
    """Raise `SceneError` for a folder none of whose files, by their names alone, shows the object."""
    if not folder.is_dir():
        raise SceneError.expected("a folder with photographs, a video or a mesh", file=folder, advice="check the name")
    if settings.surface is None and not shows_object(folder, settings):
        raise no_views(folder)


def no_views(folder: Path) -> SceneError:
    """Return the error of a folder that shows nothing of the object."""
    return SceneError(
        f"{folder}: expected photographs (transforms.json, a COLMAP model or a folder images/), a video, a mesh "
        "(surface.obj, .ply, .glb, .stl) or Gaussians (splats.ply), got none",
        file=folder,
    )


def similar_name(name: str, names: Iterable[str]) -> str | None:
    """Return the name of a file most similar to one, if any.

    A file with another number is another recording, not another spelling: 5.wav is similar to 005.wav, 040.wav is not.
    """
    numbers = {each: [int(digits) for digits in re.findall("[0-9]+", each)] for each in (*sorted(names), name)}
    wanted = numbers.pop(name)
    lower = {each.lower(): each for each, own in numbers.items() if not wanted or own in (wanted, [])}
    return next((lower[each] for each in get_close_matches(name.lower(), lower, n=1, cutoff=0.7)), None)
