"""Options of `avmsf demo`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.common import Printing
from avmsf.cli.options.paths import NewFolder

STAGES = ".demo"
"""Folder in the demo's that keeps what its stages make."""


@dataclass(frozen=True)
class Options(Printing):
    """Run a complete example: from photographs and recordings of a mug to its sound field, sounds and images.

    A ceramic mug, made by `avmsf simulate example`: 48 photographs and 16 impacts. Gaussians are fitted to the
    photographs, and the mug's shape is reconstructed from both. A field is fitted to 12 of the impacts, which also
    determine the thickness of the mug's wall, and tested on the other 4.
    """

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FOLDER"), NewFolder()]] = Path("demo")
    """Folder for all results, new, empty, or of an earlier or interrupted demo, which goes on from where it was."""

    def check_inputs(self) -> None:
        """Raise the package's errors for a folder that cannot be written or holds files that are not of a demo."""
        super().check_inputs()
        if self.folder.is_dir() and any(self.folder.iterdir()) and not (self.folder / STAGES).is_dir():
            raise OutputError.expected(
                "a new or empty folder, or an earlier demo's",
                "one with files",
                file=self.folder,
                advice="choose another",
            )
