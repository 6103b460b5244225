"""The one warning of this package: the capture can be read, but something in it is probably wrong."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avmsf.errors import AvmsfWarning


class CaptureWarning(AvmsfWarning):
    """A capture was read, but a recording or a contact in it is probably wrong; the message says what to do."""


@dataclass(frozen=True)
class Remark:
    """What looks wrong in a file, before the file's name is known."""

    message: str
    name: str | None = None
    value: Any = None

    def about(self, file: Path) -> CaptureWarning:
        """Return the warning, whose message begins with the file."""
        return CaptureWarning(f"{file}: {self.message}", file=file, name=self.name, value=self.value)
