"""Options of `avmsf suggest`."""

from dataclasses import dataclass

import tyro

from avmsf.cli.options.checks import expect_capture
from avmsf.cli.options.common import Flag, Printing
from avmsf.cli.options.paths import FieldFile, OtherCapture, OutputFolder, SettingsFile
from avmsf.errors import FitError

TABLE, PICTURE = "suggested.csv", "suggested.png"
"""What the folder of results holds."""


@dataclass(frozen=True)
class Options(Printing):
    """Suggest where to record next: the contacts that reduce the expected error of the field most.

    Each suggestion assumes that those before it are recorded: record them in this order, fit again with all recordings,
    and repeat. Needs a field whose gains have a posterior, as all but `--gain-model network` have.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    count: int = 5
    """Number of contacts."""
    candidates: OtherCapture = None
    """Suggest among the contacts of this capture. By default: all of the surface that a straight hammer of 10 mm
    reaches from outside, at most 45 degrees from perpendicular."""
    unseen: Flag = False
    """Suggest on all of the body's surface, also where no photograph shows it, such as the side that it stood on."""
    settings: SettingsFile = None
    """Use this capture.toml instead of the candidates' own."""
    output: OutputFolder = None
    """Folder for suggested.csv, the list of contacts, and suggested.png, the contacts on the object."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if self.settings is not None and self.candidates is None:
            raise FitError.expected("--candidates with it", name="--settings", advice="leave it out")
        if self.unseen and self.candidates is not None:
            raise FitError.expected("no --candidates with it", got="both", name="--unseen", advice="leave one out")
        if self.candidates is not None:
            expect_capture(self.candidates, self.settings)
