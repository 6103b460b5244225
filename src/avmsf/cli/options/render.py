"""Options of `avmsf render`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.cli.options.common import Existing, FieldFile, Printing, Unit, parse_options
from avmsf.modal.config import PulseShape

Coding = Literal["float32", "int16"]
Points = tyro.conf.UseAppendAction[tuple[tuple[float, float, float], ...]]


@dataclass(frozen=True)
class Options(Printing):
    """Write the sounds of impacts anywhere on the object as wav files.

    Contacts come from --position, once per contact, or from a table with the columns x,y,z and optionally file and
    nx,ny,nz, such as a capture's impacts.csv. Each contact is moved to the nearest point of the object. An impact
    without a direction is perpendicular to the surface.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER|FILE.wav")]
    """Folder for the sounds; for a single contact also a file that ends in .wav."""
    position: Annotated[Points, tyro.conf.arg(metavar="X Y Z")] = ()
    """A contact in the object's frame."""
    direction: Annotated[Points, tyro.conf.arg(metavar="X Y Z")] = ()
    """Direction of the impact at each --position, in the same order."""
    contact_table: Annotated[Path | None, tyro.conf.arg(metavar="TABLE.csv"), Existing("a table of contacts")] = None
    """Table of contacts."""
    unit: Unit = "m"
    """Unit of the coordinates. A field itself is in meters, whatever unit its capture has."""
    force: float = 1.0
    """Peak force of the impact, in newtons if the field knows forces, otherwise relative to an average recorded
    impact."""
    contact_time: float = 0.0
    """Contact time of a softer hammer, in seconds, with the same impulse: 0.002 for felt. 0: as recorded."""
    pulse: PulseShape = "half-sine"
    """Force over the contact time. half-sine: a linear contact. hertz: a Hertzian contact of two round bodies."""
    seconds: float | None = None
    """Length of the sounds; by default that of the training sounds."""
    normalize: Literal["none", "peak"] = "none"
    """none: the scale of the recordings. peak: all sounds times one factor, so that the loudest reaches full scale."""
    level_db: float = 0.0
    """Additional gain in dB."""
    coding: Coding = "float32"
    """Format of the samples. float32 holds any level; int16 rejects sounds that would clip."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "render", words)
