"""Errors about files: where in one something is, and folders that are not empty."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avmsf.errors import CaptureError


@dataclass(frozen=True)
class Location:
    """A file, or one item in it."""

    file: Path | str
    row: int | None = None
    """Line of a table from 1, or index in a list from 0."""
    item: str = ""
    """What messages call it: "row 3", "frame 0", "image left.png"."""

    def __str__(self) -> str:
        return f"{self.file}, {self.item}" if self.item else str(self.file)

    def error(self, message: str, *, name: str | None = None, value: Any = None) -> CaptureError:
        """Return an error about what is there."""
        return CaptureError(f"{self}: {message}", file=self.file, row=self.row, name=name, value=value)


def expect_free(folder: Path) -> None:
    """Raise CaptureError unless a folder is empty or does not exist."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(
            f"{folder}: expected a new or empty folder, got an existing one: choose another name or remove it",
            file=folder,
        )
