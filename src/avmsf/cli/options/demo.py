"""Options of `avmsf demo`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.common import Printing, parse_options
from avmsf.cli.options.paths import NewFolder


@dataclass(frozen=True)
class Options(Printing):
    """Run a complete example: from photographs and recordings of a mug to its sound field, sounds and images.

    A ceramic mug, made by `avmsf simulate example`: 48 photographs and 16 impacts. Gaussians are fitted to the
    photographs, and the mug's shape is reconstructed from both. A field is fitted to 12 of the impacts, which also
    determine the thickness of the mug's wall, and tested on the other 4.
    """

    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FOLDER"), NewFolder()]] = Path("demo")
    """Folder for all results, new or empty."""

    def check_inputs(self) -> None:
        """Raise the package's errors for a folder that cannot be written or holds files."""
        super().check_inputs()
        if self.folder.is_dir() and any(self.folder.iterdir()):
            raise OutputError.expected(
                "a new or empty folder",
                "one with files",
                file=self.folder,
                advice="choose another folder, or remove the earlier demo",
            )


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "demo", words)
