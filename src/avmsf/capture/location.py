"""Errors about files: where in one something is, and folders that are not empty."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avmsf.errors import CaptureError


@dataclass(frozen=True)
class Location:
    """A file, one item in it, or an item alone."""

    file: Path | str | None
    row: int | None = None
    """Line of a table from 1, or index in a list from 0."""
    item: str = ""
    """What messages call it: "row 3", "frame 0", "image left.png"."""

    def __str__(self) -> str:
        return ", ".join(str(part) for part in (self.file, self.item) if part)

    def error(self, message: str, *, name: str | None = None, value: Any = None) -> CaptureError:
        """Return an error about what is there."""
        return CaptureError(f"{self}: {message}", file=self.file, row=self.row, name=name, value=value)


def check_free(folder: Path) -> None:
    """Raise CaptureError unless a folder is empty or does not exist."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(
            f"{folder}: expected a new or empty folder, got an existing one; choose another name or remove it",
            file=folder,
        )
