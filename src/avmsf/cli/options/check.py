"""Options of `avmsf check`."""

from collections.abc import Sequence
from dataclasses import dataclass

import tyro

from avmsf.capture.table import read_rows
from avmsf.cli.options.checks import read_settings
from avmsf.cli.options.common import Flag, Printing, parse_options
from avmsf.cli.options.paths import CaptureFolder, SettingsFile


@dataclass(frozen=True)
class Options(Printing):
    """Check the recordings of a capture: levels, noise, clipping, onsets, second impacts and alignment.

    Prints one row per recording and the problems below. The peak is relative to full scale, the noise (root mean
    square) to the recording's own peak. The delay, in samples, aligns a recording with the others. The
    exit code is 0 if the capture can be read, with or without warnings, and 2 if it cannot.
    """

    capture: tyro.conf.Positional[CaptureFolder]
    """Folder with impacts.csv and the recordings that it names."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the folder's own."""
    write_settings: Flag = False
    """Write the proposed settings, with the reasons, to the folder's capture.toml, and check with them. An existing
    capture.toml is not changed."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if not self.json:
            # JSON reports also what is wrong with the folder as a whole.
            read_settings(self.capture, self.settings)
            read_rows(self.capture)


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "check", words)
