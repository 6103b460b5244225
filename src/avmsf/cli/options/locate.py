"""Options of `avmsf locate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.common import Flag, Printing, Unit
from avmsf.cli.options.paths import ContactTable, Existing, FieldFile, OutputFolder, SettingsFile
from avmsf.errors import AvmsfError

RECORDING = Existing("a recording", ("a recording",))


@dataclass(frozen=True)
class Options(Printing):
    """Find where on the object the impact of a recording was, with a heat map and the uncertainty.

    Each recording holds one impact, of any force and polarity; with --several, any number of them.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    recordings: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RECORDING.wav ...")]]
    """Recordings of impacts on the same object: wav, flac or another format that libsndfile reads."""
    settings: SettingsFile = None
    """Read the recordings by this capture.toml; by default like the recordings of the fit."""
    several: Flag = False
    """The recordings hold several impacts each; locate every one of them."""
    force: float | None = None
    """Peak force of every impact in newtons: it distinguishes contacts that differ only in loudness. 1 for recordings
    that were divided by their forces already. For a field whose recordings were not divided by their forces: relative
    to an average recorded impact."""
    probability: float = 0.9
    """Probability that the contact lies within the region that is reported."""
    true_contact: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """True contact of every impact: its distance is printed, and whether it lies within the region; the heat maps mark
    it red and the located one blue."""
    true_contact_table: ContactTable = None
    """True contacts of several recordings: a table with the columns file,x,y,z, such as a capture's impacts.csv."""
    unit: Unit = "m"
    """Unit of --true-contact and --true-contact-table. The field itself is in meters, also where its capture is in
    another unit."""
    output: OutputFolder = None
    """Folder for a heat map and a colored point cloud of every impact, NAME.png and NAME.ply."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if not self.recordings:
            raise OutputError.expected("one or more after the field, such as HIT.wav", 0, name="recordings")
        # One that is missing does not keep the others from being located.
        failures = []
        for path in self.recordings:
            try:
                RECORDING.check(path)
            except AvmsfError as error:
                failures.append(error)
        if len(failures) == len(self.recordings):
            raise failures[0]
        if self.true_contact is not None and self.true_contact_table is not None:
            wanted = "true contacts by it, X Y Z, or by --true-contact-table TABLE.csv"
            raise OutputError.expected(wanted, list(self.true_contact), got="both", name="--true-contact")
        if not 0.0 < self.probability < 1.0:
            raise OutputError.expected(
                "a probability between 0 and 1, such as 0.9", self.probability, name="--probability"
            )
