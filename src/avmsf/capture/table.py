"""`impacts.csv`: one row a recording, where it was struck and, where known, which way and how hard."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath

from avmsf._utils.text_files import read_text
from avmsf.capture.settings import METRES, CaptureSettings
from avmsf.errors import CaptureError

TABLE = "impacts.csv"
REQUIRED = ("file", "x", "y", "z")
DIRECTION = ("nx", "ny", "nz")
FORCE = "force_newtons"
MAX_ROWS = 10_000
"""Rows of a table: three times the 3,000 recordings that RealImpact, the largest published set, has of an object."""
MIN_FORCE_NEWTONS, MAX_FORCE_NEWTONS = 1e-6, 1e6
"""Peak forces that a row may give: from a grain of dust to the largest impact hammers (2e4 N) and beyond."""
FARTHEST = 100.0
"""Meters from the origin beyond which a contact cannot be meant."""
HOW_TO_WRITE = (
    f"{TABLE} has the header line file,x,y,z (and if known nx,ny,nz,force_newtons) and one row a recording, "
    "for example: 001.wav,0.12,0.05,0.30. Without recordings, avmsf fit --material NAME guesses a field from the shape"
)


@dataclass(frozen=True)
class Row:
    """One row as it is written, not yet understood."""

    line: int
    """Line of the file, counted from 1 with the header, as spreadsheets and editors count."""
    cells: Mapping[str, str]
    """Text of each known column, without spaces around it."""
    decimal_comma: bool
    """Whether numbers may be written 0,75: so in tables whose columns are not separated by commas."""


@dataclass(frozen=True)
class Strike:
    """One row understood."""

    file: str
    """Path of the wav file inside the capture folder, with forward slashes."""
    line: int
    contact: tuple[float, float, float]
    """Meters."""
    direction: tuple[float, float, float] | None
    """Unit vector."""
    newtons: float | None


def read_cells(path: Path) -> tuple[list[tuple[int, list[str]]], str]:
    """Return a table's lines that are not blank, each with its number and its cells, and what separates the cells.

    Raises `CaptureError` for a file that is no table of UTF-8 text, or has more than `MAX_ROWS` rows.
    """
    try:
        text = read_text(path)
        first = text.lstrip().split("\n", 1)[0]
        separator = max(",;\t", key=first.count)
        reader = csv.reader(io.StringIO(text), delimiter=separator)
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in islice(reader, MAX_ROWS + 2)]
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path}: not UTF-8 text: save it from the spreadsheet as 'CSV UTF-8'") from error
    except (OSError, ValueError, csv.Error) as error:
        raise CaptureError(f"{path}: not a table that can be read: {error}") from error
    if len(lines) > MAX_ROWS + 1:
        raise CaptureError(f"{path}: expected at most {MAX_ROWS:,} rows, got more: divide the table")
    return [(line, cells) for line, cells in lines if any(cells)], separator


def read_rows(folder: Path) -> tuple[list[Row], list[str]]:
    """Read the rows of the folder's `impacts.csv`, and remarks about columns that are not used.

    Commas, semicolons and tabs separate; a byte-order mark, Windows line ends, blank lines, upper case and spaces in
    the header do no harm. `CaptureError` where there is no table, no row, a column is missing or double, or a row is
    of another length than the header.
    """
    path = folder / TABLE
    if not folder.is_dir():
        raise CaptureError(f"{folder}: there is no such folder")
    if not path.is_file():
        raise CaptureError(f"{folder}: there is no {TABLE} in this folder; {HOW_TO_WRITE}")
    lines, separator = read_cells(path)
    if not lines:
        raise CaptureError(f"{path}: the table is empty; {HOW_TO_WRITE}")
    header = [name.lower() for name in lines[0][1]]
    remarks = _judge_header(header, path)
    rows = []
    for line, cells in lines[1:]:
        if len(cells) != len(header):
            raise CaptureError(
                f"{TABLE} line {line}: {len(cells)} cells where the header has {len(header)}: {separator.join(cells)}"
            )
        rows.append(Row(line, dict(zip(header, cells, strict=True)), separator != ","))
    if not rows:
        raise CaptureError(f"{path}: the table has a header and no row; {HOW_TO_WRITE}")
    return rows, remarks


def understand(row: Row, settings: CaptureSettings) -> Strike:
    """Turn one row into a contact in meters, a unit direction and a force; `CaptureError` names the line and value."""
    where = f"{TABLE} line {row.line}"
    written = [_number(row, name) for name in ("x", "y", "z")]
    contact = [value * settings.meters for value in written]
    farthest = max(written, key=abs)
    if abs(farthest) * settings.meters > FARTHEST:
        raise CaptureError(
            f"{where}: the contact ({', '.join(row.cells[name] for name in ('x', 'y', 'z'))}) lies "
            f"{math.hypot(*contact):.4g} m away (unit = {settings.unit!r}): {fitting_units(abs(farthest))}"
        )
    direction = None
    if DIRECTION[0] in row.cells:
        direction = _unit_vector([_number(row, name) for name in DIRECTION], where)
    newtons = None
    if FORCE in row.cells:
        newtons = _number(row, FORCE)
        if not MIN_FORCE_NEWTONS <= newtons <= MAX_FORCE_NEWTONS:
            raise CaptureError(
                f"{where}: {FORCE} is {newtons:g}; expected a peak force of {MIN_FORCE_NEWTONS:g} to "
                f"{MAX_FORCE_NEWTONS:g} N"
            )
    return Strike(_inside(row.cells["file"], where), row.line, (contact[0], contact[1], contact[2]), direction, newtons)


def refuse_repeated_files(strikes: Sequence[Strike]) -> None:
    """Raise `CaptureError` where two rows name one file: one of the two contacts must be wrong."""
    lines: dict[str, int] = {}
    for strike in strikes:
        if strike.file in lines:
            raise CaptureError(
                f"{TABLE} line {strike.line}: {strike.file} stands in line {lines[strike.file]} already; "
                "each row needs its own recording"
            )
        lines[strike.file] = strike.line


def fitting_units(written: float) -> str:
    """Say in which units a coordinate would belong to an object that one can strike by hand (1 cm to 5 m)."""
    fitting = [(unit, written * size) for unit, size in METRES.items() if 0.01 <= written * size <= 5]
    if not fitting:
        return "no unit would make that an object one can strike: mend the row"
    choices = " or ".join(f'unit = "{unit}" ({meters:.3g} m)' for unit, meters in fitting)
    return f"write in capture.toml what the numbers count: {choices}"


def _judge_header(header: Sequence[str], path: Path) -> list[str]:
    missing = [name for name in REQUIRED if name not in header]
    if missing:
        raise CaptureError(
            f"{path}: the column{'s' * (len(missing) > 1)} {', '.join(missing)} "
            f"{'are' if len(missing) > 1 else 'is'} missing, found {', '.join(header)}; {HOW_TO_WRITE}"
        )
    directions = [name for name in DIRECTION if name in header]
    if 0 < len(directions) < 3:
        raise CaptureError(f"{path}: a direction needs all of nx, ny, nz; found only {', '.join(directions)}")
    known = (*REQUIRED, *DIRECTION, FORCE)
    double = sorted({name for name in header if name in known and header.count(name) > 1})
    if double:
        raise CaptureError(f"{path}: more than one column is called {', '.join(double)}")
    extra = [name or "(no name)" for name in header if name not in known]
    return [f"{path}: columns that are not used: {', '.join(extra)}"] if extra else []


def _number(row: Row, name: str) -> float:
    text = row.cells[name]
    try:
        value = float(text.replace(",", ".") if row.decimal_comma else text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise CaptureError(f"{TABLE} line {row.line}: {name} is {text!r}; expected a number")
    return value


def _unit_vector(values: Sequence[float], where: str) -> tuple[float, float, float]:
    length = math.hypot(*values)
    if length == 0:
        raise CaptureError(f"{where}: nx,ny,nz is the zero vector, which points nowhere: give a direction or drop them")
    # What has unit length already stays as it is, so that writing and reading again changes no digit.
    scale = 1.0 if abs(length - 1) < 1e-6 else 1 / length
    return (values[0] * scale, values[1] * scale, values[2] * scale)


def _inside(text: str, where: str) -> str:
    """Return the path with forward slashes; `CaptureError` for one that leaves the folder.

    A capture is one folder that can be moved, sent and read by others, so nothing outside it belongs to it.
    """
    path = PurePosixPath(text.replace("\\", "/"))
    if not text:
        raise CaptureError(f"{where}: file is empty; expected a wav file's path inside the folder")
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise CaptureError(f"{where}: {text} lies outside the capture folder: copy it there and give its path from it")
    return str(path)
