"""Options of `avmsf render`."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.cli.options.checks import OutputError
from avmsf.cli.options.common import Flag, Printing, Unit
from avmsf.cli.options.paths import ContactTable, FieldFile, NewFile, PositionList
from avmsf.modal.config import PulseShape
from avmsf.simulate.recipe import MAX_CONTACT_SECONDS

Coding = Literal["float32", "int16"]


@dataclass(frozen=True)
class Options(Printing):
    """Write the sounds of impacts anywhere on the object as wav files.

    Contacts come from --position, once per contact, or from a table with the columns x,y,z and optionally file and
    nx,ny,nz, such as a capture's impacts.csv. An impact without a direction is perpendicular to the surface.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    output: Annotated[
        Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER|FILE.wav"), NewFile((".wav",), or_folder=True)
    ]
    """Folder for the sounds; for a single contact also a file that ends in .wav."""
    position: PositionList = ()
    """A contact in the object's frame."""
    direction: PositionList = ()
    """Direction of the impact at each --position, in the same order."""
    contact_table: ContactTable = None
    """Table of contacts. In it, a direction that is empty or 0,0,0 is not known."""
    unit: Unit = "m"
    """Unit of the coordinates. The field itself is in meters, also where its capture is in another unit."""
    force: float = 1.0
    """Peak force of the impact, in newtons if the field knows forces, otherwise relative to an average recorded
    impact."""
    contact_time: float = 0.0
    """Contact time of a softer hammer, in seconds, with the same impulse: 0.002 for felt. 0: as recorded."""
    pulse: PulseShape = "half-sine"
    """Force over the contact time. half-sine: a linear contact. hertz: a Hertzian contact of two round bodies."""
    no_noise: Flag = False
    """Write the modes without the residual noise."""
    seconds: float | None = None
    """Length of the sounds; by default that of the training sounds."""
    normalize: Literal["none", "peak"] = "none"
    """none: the scale of the recordings. peak: all sounds times one factor, so that the loudest reaches full scale."""
    level_db: float = 0.0
    """Additional gain in dB."""
    coding: Coding = "float32"
    """Format of the samples. float32 holds any level; int16 rejects sounds that would clip."""

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        if bool(self.position) == (self.contact_table is not None):
            wanted = "contacts by it, X Y Z, once or more, or by --contact-table TABLE.csv"
            raise OutputError.expected(wanted, len(self.position), name="--position")
        if self.direction and len(self.direction) != len(self.position):
            wanted = f"one for each of {len(self.position)} --position"
            raise OutputError.expected(wanted, len(self.direction), name="--direction")
        for row, place in enumerate(self.position):
            if not all(map(math.isfinite, place)):
                raise OutputError.expected("finite coordinates", list(place), row=row, name="--position")
        for row, way in enumerate(self.direction):
            if not (any(way) and all(map(math.isfinite, way))):
                advice = "leave out --direction for impacts perpendicular to the surface"
                raise OutputError.expected(
                    "a direction other than 0 0 0", list(way), row=row, name="--direction", advice=advice
                )
        if not math.isfinite(self.level_db):
            raise OutputError.expected("a finite number", self.level_db, name="--level-db")
        if not 0 < self.force < math.inf:
            advice = "--direction says which way it acts"
            raise OutputError.expected("a finite force above 0", self.force, name="--force", advice=advice)
        if not 0 <= self.contact_time <= MAX_CONTACT_SECONDS:
            raise OutputError.expected(
                f"seconds from 0 to {MAX_CONTACT_SECONDS:g}", self.contact_time, name="--contact-time"
            )
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise OutputError.expected("more than 0", self.seconds, name="--seconds")
