"""Options of `avmsf check`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.capture.settings import SETTINGS, TABLE
from avmsf.capture.table import read_rows
from avmsf.cli.options.checks import read_settings
from avmsf.cli.options.common import Flag, Printing
from avmsf.cli.options.paths import Existing, SettingsFile
from avmsf.datasets.detect import detect_dataset
from avmsf.errors import CaptureError


@dataclass(frozen=True)
class Options(Printing):
    """Check the recordings of a capture: levels, noise, clipping, onsets, second impacts and alignment.

    Prints one row per recording and the problems below. The peak is relative to full scale, the noise (root mean
    square) to the recording's own peak. The delay, in samples, aligns a recording with the others. The exit code is 0
    if the capture can be read, with or without warnings, and 2 if it cannot.

    Of a dataset (ObjectFolder Real, RealImpact, or a folder of captures) the objects are listed instead: what can be
    read, and what is missing; sounds are not read. The exit code is then 0 if at least one object can be read.
    """

    capture: tyro.conf.Positional[
        Annotated[Path, tyro.conf.arg(metavar="CAPTURE|DATASET"), Existing("a capture or a dataset", ("a folder",))]
    ]
    """Folder with impacts.csv and the recordings that it names, or of a dataset."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    write_settings: Flag = False
    """Write the proposed settings, with the reasons, to the folder's capture.toml, and check with them. An existing
    capture.toml is not changed."""
    contact_data: Annotated[
        Path | None, tyro.conf.arg(metavar="FOLDER"), Existing("ObjectFolder Real's contacts", ("a folder",))
    ] = None
    """ObjectFolder Real's contacts: SonicGauss's lists in a folder, or one of them."""

    @property
    def is_dataset(self) -> bool:
        """Whether the folder is a dataset: it holds no recordings itself."""
        return not (self.capture / TABLE).is_file() and not any(self.capture.glob("*.wav"))

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if self.write_settings and self.settings is not None:
            wanted, advice = "--write-settings without it", f"the new {SETTINGS} would not contain its settings"
            raise CaptureError.expected(wanted, got="both", file=self.settings, name="--write-settings", advice=advice)
        if self.is_dataset:
            detect_dataset(self.capture)
            for option, given in (("--settings", self.settings), ("--write-settings", self.write_settings or None)):
                if given is not None:
                    raise CaptureError.expected("a capture with it", "a dataset", file=self.capture, name=option)
        elif not self.json:
            # JSON reports also what is wrong with the folder as a whole.
            read_settings(self.capture, self.settings)
            read_rows(self.capture)
