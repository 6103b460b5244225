"""Contacts to render, from the command line or from a table, each with the name of its sound."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.capture.table import read_cells
from avmsf.cli.writing import OutputError
from avmsf.errors import CaptureError, PositionError
from avmsf.field.soundfield import SoundField, expect_near

_COLUMNS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
"""Direction of an impact, into the object, as in impacts.csv."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where to strike, and what to call each sound."""

    places: Float64[Tensor, "contacts 3"]
    """Object frame, meters."""
    names: tuple[str, ...]
    """Paths of wav files in the output folder."""
    directions: Float64[Tensor, "contacts 3"] | None = None
    """Of the impacts, zero where unknown; None if none is known."""


def contacts_at(
    places: Sequence[tuple[float, float, float]],
    *,
    meters: float,
    directions: Sequence[tuple[float, float, float]] = (),
) -> Contacts:
    """Number the contacts that the command line gives, whose coordinates count `meters` each."""
    return Contacts(
        torch.tensor(places, dtype=torch.float64).reshape(-1, 3) * meters,
        tuple(f"{number:03d}.wav" for number in range(1, len(places) + 1)),
        torch.tensor(directions, dtype=torch.float64) if directions else None,
    )


def read_contacts(path: Path, *, meters: float) -> Contacts:
    """Read a table with the columns x, y, z and perhaps file, nx, ny and nz, such as a capture's impacts.csv.

    Other columns are ignored. Sounds are called as the column `file` says, else by number. Raises `CaptureError` with
    the line at fault.
    """
    lines, separator = read_cells(path)
    header = [name.lower() for name in lines[0][1]] if lines else []
    missing = [name for name in _COLUMNS if name not in header]
    if missing or len(lines) < 2:
        lacking = f"the column {missing[0]} is missing" if missing else "there is no row"
        raise CaptureError(
            f"{path}: {lacking}; expected a header line with x,y,z (and perhaps file) and one row for each impact"
        )
    places, names, normals = [], [], []
    for line, cells in lines[1:]:
        row = dict(zip(header, cells, strict=False))
        places.append([_number(row.get(name, ""), f"{path} line {line}: {name}", separator) for name in _COLUMNS])
        normals.append([_number(row.get(name) or "0", f"{path} line {line}: {name}", separator) for name in _NORMALS])
        names.append(_wav_name(row["file"], f"{path} line {line}") if "file" in row else f"{len(places):03d}.wav")
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise CaptureError(f"{path}: more than one row is to become {repeated}; each needs a name of its own")
    directions = torch.tensor(normals, dtype=torch.float64)
    known = directions if bool(directions.any()) else None
    return Contacts(torch.tensor(places, dtype=torch.float64) * meters, tuple(names), known)


def refuse_far(contacts: Contacts, field: SoundField) -> None:
    """Raise `OutputError` for a contact that is not on the object, see `expect_near`."""
    try:
        expect_near(contacts.places, field.gain_field.points)
    except PositionError as error:
        name = contacts.names[error.row or 0]
        raise OutputError(f"{name}: {error}; --unit says what the numbers count") from error


def _number(text: str, where: str, separator: str) -> float:
    try:
        # Tables that are not separated by commas may write 0,75.
        value = float(text if separator == "," else text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CaptureError(f"{where} is {text!r}; expected a number")
    return value


def _wav_name(text: str, where: str) -> str:
    path = PurePosixPath(text.replace("\\", "/"))
    if not path.name or path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise CaptureError(f"{where}: file is {text!r}; expected the name of a wav file inside the output folder")
    return str(path if path.suffix.lower() == ".wav" else path.with_name(f"{path.name}.wav"))
