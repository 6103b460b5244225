"""Options of `avmsf dataset check`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.common import Printing
from avmsf.cli.options.paths import Existing
from avmsf.datasets.detect import detect_dataset


@dataclass(frozen=True)
class Options(Printing):
    """List the objects of a published dataset: what can be read, and what is missing.

    Supported are ObjectFolder Real, RealImpact, and folders of captures. Sounds are not read. The exit code is 0 if at
    least one object can be read, and 2 otherwise.
    """

    dataset: tyro.conf.Positional[
        Annotated[Path, tyro.conf.arg(metavar="DATASET"), Existing("a dataset's folder", ("a folder",))]
    ]
    """Folder of the dataset."""
    contact_data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER"), Existing("ObjectFolder Real's contacts", ("a folder",))
    ] = None
    """ObjectFolder Real's contacts: SonicGauss's lists in a folder, or one of them."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        detect_dataset(self.dataset)


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    options: Options = tyro.extras.subcommand_cli_from_dict({"check": Options}, prog="avmsf dataset", args=words)
    return options
