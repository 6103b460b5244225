"""Checks of options that load nothing that computes: a mistake is reported at once."""

from pathlib import Path

from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.capture.table import read_strikes
from avmsf.errors import AvmsfError, ExtractionError

DEVICES = ("cpu", "cuda")
"""Kinds of devices that commands compute on."""


class OutputError(AvmsfError):
    """An option or an output of a command cannot be used."""


def expect_writable(path: Path | None) -> None:
    """Raise `OutputError` where no file can be written at `path`, where one is given: before work of minutes."""
    if path is None:
        return
    if path.is_dir():
        raise OutputError(f"{path}: expected the name of a file, got a folder", file=path, value="folder")
    folder = path.parent
    existing = next(place for place in (folder, *folder.resolve().parents) if place.exists())
    if not existing.is_dir():
        raise OutputError(
            f"{path}: expected a folder at {existing}, got a file; choose another folder", file=existing, value="file"
        )


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
    """Raise `CaptureError` for a capture folder whose table or settings cannot be used."""
    read_strikes(folder, read_settings(folder, settings))
