"""Contacts from the command line or from a table, each with the name of its sound."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.arrays import as_vectors
from avmsf.capture.settings import METRES
from avmsf.capture.table import DIRECTION, REQUIRED, Row, is_inside, read_table
from avmsf.cli.options import Unit
from avmsf.cli.output import note
from avmsf.cli.paths import OutputError
from avmsf.errors import PositionError
from avmsf.field.gains.model import expect_near, off_surface
from avmsf.field.sound_field import SoundField

_Vectors = Sequence[tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts, and the name of each sound."""

    places: Float64[Tensor, "contacts 3"]
    """Object frame, meters."""
    names: tuple[str, ...]
    """Paths of wav files in the output folder, or of recordings."""
    directions: Float64[Tensor, "contacts 3"] | None = None
    """Of the impacts, zero where unknown; None if none is known."""
    option: str = "--position"
    """The option that gives them where there is no table."""
    table: Path | None = None
    lines: tuple[int, ...] = ()
    """Line of the table of each."""

    def label(self, row: int) -> str:
        """Return where a user wrote a contact: the option, with its number if there are several, or file and row."""
        if self.table is not None:
            return f"{self.table}, row {self.lines[row]}"
        return self.option if len(self.names) == 1 else f"{self.option} {row + 1} of {len(self.names)}"


def contacts_on(
    field: SoundField,
    places: _Vectors,
    table: Path | None = None,
    *,
    unit: Unit,
    directions: _Vectors = (),
    option: str = "--position",
    recordings: bool = False,
    advice: str = ", see --unit",
) -> Contacts:
    """Return the contacts that an option gives, numbered, or those of a table, see `_read_contacts`.

    Notes which are off the surface of a field's object, see `off_surface`. Raises `ArrayError` for no numbers, and
    `OutputError` for a contact that is not near the object, see `expect_near`, whose message `advice` ends.
    """
    if table is not None:
        contacts = _read_contacts(table, unit=unit, recordings=recordings)
    else:
        contacts = Contacts(
            as_vectors(torch.tensor(places, dtype=torch.float64).reshape(-1, 3), option) * METRES[unit],
            tuple(f"{number:03d}.wav" for number in range(1, len(places) + 1)),
            torch.tensor(directions, dtype=torch.float64) if directions else None,
            option,
        )
    try:
        expect_near(contacts.places, field.gain_field.points, contacts.label)
    except PositionError as error:
        row = error.row or 0
        where: dict[str, Any] = {"name": option, "row": row}
        if table is not None:
            where = {"file": table, "name": contacts.names[row], "row": contacts.lines[row]}
        raise OutputError(f"{error}{advice}", **{**error.attributes, **where}) from error
    for row, distance in off_surface(contacts.places, field.gain_field):
        note(f"{contacts.label(row)} is {1e3 * distance:.3g} mm off the object's surface")
    return contacts


def _read_contacts(path: Path, *, unit: Unit, recordings: bool) -> Contacts:
    """Read a table with the columns x, y, z and perhaps file, nx, ny and nz, such as a capture's impacts.csv.

    Sounds are named by the column `file`, else by number. They are files to write in an output folder, and columns that
    are not used are noted; with `recordings` files to read, in any folder, and every row must name one. Raises
    `CaptureError` with the line at fault as `row`, counted from 1 with the header, as in all tables.
    """
    file, *axes = REQUIRED
    required = (file, *axes) if recordings else axes
    advice = f"give one row for each impact, below the header {','.join(required)}"
    rows, unused = read_table(path, required, (file, *DIRECTION), advice=advice)
    if unused and not recordings:
        note(f"{path}: columns that are not used: {', '.join(unused)}")
    places = [[row.number(name) for name in axes] for row in rows]
    # A direction that is not given is zero.
    normals = [[row.number(name) if row.cells.get(name) else 0.0 for name in DIRECTION] for row in rows]
    names = list[str]()
    for number, row in enumerate(rows, start=1):
        name = _wav_name(row, anywhere=recordings) if file in row.cells else f"{number:03d}.wav"
        if name in names:
            raise row.error("a name that no other row has", name, name=file)
        names.append(name)
    return Contacts(
        torch.tensor(places, dtype=torch.float64) * METRES[unit],
        tuple(names),
        torch.tensor(normals, dtype=torch.float64) if np.any(normals) else None,
        table=path,
        lines=tuple(row.line for row in rows),
    )


def rows_of(contacts: Contacts, recording: Path) -> list[int]:
    """Return the rows of a table that have the file name of a recording.

    If the path of one of them is the end of the recording's path, only that row is returned: of several such rows, the
    one with the longest path.
    """
    sound = _with_suffix(PurePosixPath(recording.absolute().as_posix()))
    rows = [row for row, name in enumerate(contacts.names) if PurePosixPath(name).name == sound.name]
    ends = [row for row in rows if str(sound).endswith("/" + contacts.names[row].lstrip("/"))]
    return [max(ends, key=lambda row: len(contacts.names[row]))] if ends else rows


def _wav_name(row: Row, *, anywhere: bool) -> str:
    sound = PurePosixPath(row.file.replace("\\", "/"))
    if not sound.name or not (anywhere or is_inside(sound)):
        wanted = "the name of a recording" if anywhere else "the name of a wav file inside the output folder"
        raise row.error(wanted, row.file, name="file")
    return str(_with_suffix(sound))


def _with_suffix(sound: PurePosixPath) -> PurePosixPath:
    return sound if sound.suffix.lower() == ".wav" else sound.with_name(f"{sound.name}.wav")
