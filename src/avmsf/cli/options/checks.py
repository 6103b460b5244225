"""Checks of options that load nothing that computes: a mistake is reported at once."""

from pathlib import Path

from avmsf._utils.files import temporary_path, unwritable
from avmsf.capture.filenames import find_surface_file
from avmsf.capture.issues import Issues
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.capture.table import present_impacts, read_impacts
from avmsf.errors import AvmsfError, CaptureError, ExtractionError

DEVICES = ("cpu", "cuda")
"""Kinds of devices that commands compute on."""


_PLY_HEADER_BYTES = 1 << 16
"""Bytes in which the header of a .ply ends: a hundred times those of a mesh with colors and normals."""


class OutputError(AvmsfError):
    """An option or an output of a command cannot be used."""


def expect_writable(path: Path | None) -> None:
    """Raise `OutputError` where no file can be written at `path`, where one is given: before work of minutes."""
    if path is None:
        return
    if is_folder(path):
        raise OutputError.expected("the name of a file", "folder", got="a folder", file=path)
    folder = path.parent
    existing = next(place for place in (folder, *folder.resolve().parents) if place.exists())
    if not existing.is_dir():
        advice = f"choose another folder for {path.name}"
        raise OutputError.expected("a folder", "file", got="a file", file=existing, advice=advice)


def is_folder(path: Path) -> bool:
    """Return whether a folder is at the path of an output. Raises `OutputError` where the system accepts no such path.

    Its name may be too long, or a folder above it may not be searched.
    """
    try:
        # Files are written under a longer name first.
        (temporary_path(path) if path.name else path).exists()
        return path.is_dir()
    except OSError as error:
        raise unwritable(path, error, raising=OutputError) from error


def expect_device(name: str | None, *, raising: type[AvmsfError]) -> None:
    """Raise `raising` for the name of a device of another kind than `DEVICES`."""
    if name is not None and name.partition(":")[0] not in DEVICES:
        raise raising.expected(" or ".join(DEVICES), name, name="device")


def expect_modes(modes: int) -> None:
    """Raise `ExtractionError` unless at least one mode is asked for."""
    if modes < 1:
        raise ExtractionError.expected("1 or more", modes, name="modes")


def read_settings(folder: Path, settings: Path | None) -> CaptureSettings:
    """Return the settings of a file, or without one those of a capture folder."""
    return settings_of(folder) if settings is None else CaptureSettings.read(settings)


def expect_capture(folder: Path, settings: Path | None) -> None:
    """Raise `CaptureError` for a capture folder whose table, settings or surface cannot be used, see `expect_rows`."""
    expect_rows(folder, read_settings(folder, settings))


def expect_rows(folder: Path, settings: CaptureSettings) -> None:
    """Raise `CaptureError` for a capture folder whose table cannot be used, or whose .ply has no such header."""
    present_impacts(folder, read_impacts(folder, settings, Issues()), Issues())
    surface = find_surface_file(folder, settings)
    if surface is None or surface.suffix.lower() != ".ply" or not surface.is_file():
        return
    with surface.open("rb") as file:
        start = file.read(_PLY_HEADER_BYTES)
    if not start.startswith(b"ply") or b"end_header" not in start:
        raise CaptureError.expected(
            "a mesh or point cloud", start[:8], got="a file without the header of a .ply", file=surface,
            advice="export it again",
        )  # fmt: skip
