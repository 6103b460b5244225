"""`impacts.csv`: one row for each recording, with the contact and, where known, the impact's direction and force."""

import csv
import io
import math
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

from avmsf._utils.files import is_lfs_pointer
from avmsf._utils.text import listed, read_text
from avmsf.capture.filenames import files_in, missing_recording
from avmsf.capture.settings import METRES, CaptureSettings
from avmsf.errors import CaptureError, CaptureWarning

TABLE = "impacts.csv"
REQUIRED = ("file", "x", "y", "z")
DIRECTION = ("nx", "ny", "nz")
FORCE = "force_newtons"
MAX_ROWS = 10_000
"""Rows of a table: three times the 3,000 recordings that RealImpact, the largest published set, has of an object."""
MIN_FORCE_NEWTONS, MAX_FORCE_NEWTONS = 1e-6, 1e6
"""Peak forces that a row may give: from a grain of dust to the largest impact hammers (2e4 N) and beyond."""
FARTHEST = 100.0
"""Meters from the origin beyond which a contact must be in another unit."""
_NO_ROW = re.compile(r"\A(\s*sep=.(\n|\Z))?(#.*(\n|\Z))*")
"""What Excel is told the separator by, and comments above the header."""
HOW_TO_WRITE = (
    f"{TABLE} has the header file,x,y,z (and if known nx,ny,nz,force_newtons) and one row for each recording, "
    "for example: 001.wav,0.12,0.05,0.30. Without recordings, avmsf fit --material NAME computes a field from the shape"
)


@dataclass(frozen=True)
class Row:
    """One row as it is written, not yet parsed."""

    line: int
    """Line of the file, counted from 1 with the header, as spreadsheets and editors count."""
    cells: Mapping[str, str]
    """Text of each known column, without spaces around it."""
    decimal_comma: bool
    """Whether numbers may be written 0,75: so in tables whose columns are not separated by commas."""

    @property
    def file(self) -> str:
        """Name of the recording as it is written."""
        return self.cells["file"]

    def error(self, wanted: str, value: Any, *, name: str, got: str | None = None, advice: str = "") -> CaptureError:
        """Return an error about a value in this row."""
        return CaptureError.expected(wanted, value, got=got, file=TABLE, row=self.line, name=name, advice=advice)


@dataclass(frozen=True)
class Impact:
    """What is known of one impact: a row parsed, or an entry of a dataset."""

    file: str
    """What the capture calls the recording: the path of its file inside the folder, with forward slashes."""
    contact: Sequence[float]
    """Object frame, meters."""
    direction: Sequence[float] | None = None
    """Unit vector along which the hammer moved."""
    newtons: float | None = None
    """Peak force, where it is known by other means than a channel of the recording."""
    gain_db: float = 0.0
    """By how much the recorder made the sound louder, which is divided out."""
    line: int = 0
    """Line of the table."""


def read_cells(path: Path) -> tuple[list[tuple[int, list[str]]], str]:
    """Return a table's lines that are not blank, each with its number and its cells, and what separates the cells.

    Raises `CaptureError` for a file that is no table of UTF-8 text, or has more than `MAX_ROWS` rows.
    """
    if is_lfs_pointer(path):
        raise CaptureError.expected("a table", got="a Git LFS pointer", file=path, advice="run git lfs pull")
    try:
        # Blank lines in place of what are no rows, so that lines keep their numbers.
        text = _NO_ROW.sub(lambda found: "\n" * found[0].count("\n"), read_text(path))
        first = text.lstrip().split("\n", 1)[0]
        separator = max(",;\t", key=first.count)
        reader = csv.reader(io.StringIO(text), delimiter=separator)
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in islice(reader, MAX_ROWS + 2)]
    except UnicodeDecodeError as error:
        advice = "save it from the spreadsheet as 'CSV UTF-8'"
        raise CaptureError.expected("UTF-8 text", got="other bytes", file=path, advice=advice) from error
    except (OSError, ValueError, csv.Error) as error:
        raise CaptureError.expected("a table", got=f"a file that cannot be read: {error}", file=path) from error
    if len(lines) > MAX_ROWS + 1:
        wanted, advice = f"at most {MAX_ROWS:,} rows", "divide the table"
        raise CaptureError.expected(wanted, got="more", file=path, row=lines[-1][0], advice=advice)
    return [(line, cells) for line, cells in lines if any(cells)], separator


def read_rows(folder: Path) -> tuple[list[Row], list[CaptureWarning]]:
    """Read the rows of the folder's `impacts.csv`, and warnings of columns that are not used.

    Commas, semicolons and tabs separate; a byte-order mark, Windows line ends, blank lines, upper case and spaces in
    the header do no harm. `CaptureError` where there is no table, no row, a column is missing or double, or a row is
    of another length than the header.
    """
    path = folder / TABLE
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "none"
        raise CaptureError.expected("a capture folder", got=kind, file=folder, advice="check the path")
    if not path.is_file():
        raise CaptureError.expected("a table", file=path, advice=HOW_TO_WRITE)
    lines, separator = read_cells(path)
    if not lines:
        raise CaptureError.expected("a table", "", got="an empty file", file=path, advice=HOW_TO_WRITE)
    header = [name.lower() for name in lines[0][1]]
    remarks = _check_header(header, path)
    rows = []
    for line, cells in lines[1:]:
        if len(cells) != len(header):
            wanted, got = f"{len(header)} cells as in the header", f"{len(cells)}: {separator.join(cells)}"
            raise CaptureError.expected(wanted, len(cells), got=got, file=path, row=line)
        named = dict(zip(header, cells, strict=True))
        named["file"] = _as_on_disk(folder, named["file"])
        rows.append(Row(line, named, separator != ","))
    if not rows:
        raise CaptureError.expected("rows below the header", 0, got="none", file=path, advice=HOW_TO_WRITE)
    return rows, remarks


def _as_on_disk(folder: Path, file: str) -> str:
    """Return the name of a file that exists and has the same letters, composed or decomposed; else the name given."""
    if file.isascii():
        return file
    path = folder / file.replace("\\", "/")
    if is_missing(path) and path.parent.is_dir():
        wanted = unicodedata.normalize("NFC", path.name)
        same = [each for each in path.parent.iterdir() if unicodedata.normalize("NFC", each.name) == wanted]
        return same[0].relative_to(folder).as_posix() if same else file
    return file


def parse_row(row: Row, settings: CaptureSettings) -> Impact:
    """Turn one row into a contact in meters, a unit direction and a force; `CaptureError` names the row and value."""
    x, y, z = written = [_number(row, name) for name in REQUIRED[1:]]
    farthest, direction, newtons = max(map(abs, written)), None, None
    if farthest * settings.meters > FARTHEST:
        got = f"({', '.join(row.cells[name] for name in REQUIRED[1:])}) {settings.unit}"
        wanted, advice = f"a contact within {FARTHEST:g} m of the origin", fitting_units(farthest)
        raise row.error(wanted, written, got=got, name="unit", advice=advice)
    if DIRECTION[0] in row.cells:
        vector = [_number(row, name) for name in DIRECTION]
        length = math.hypot(*vector)
        if length == 0:
            wanted, advice = "a direction as nx,ny,nz", "give a direction or remove the columns"
            raise row.error(wanted, vector, got="the zero vector", name=DIRECTION[0], advice=advice)
        # What has unit length already stays as it is, so that writing and reading again changes no digit.
        scale = 1.0 if abs(length - 1) < 1e-6 else 1 / length
        direction = (vector[0] * scale, vector[1] * scale, vector[2] * scale)
    if FORCE in row.cells:
        newtons = _number(row, FORCE)
        if not MIN_FORCE_NEWTONS <= newtons <= MAX_FORCE_NEWTONS:
            wanted = f"{FORCE}, a peak force, of {MIN_FORCE_NEWTONS:g} to {MAX_FORCE_NEWTONS:g} N"
            raise row.error(wanted, newtons, name=FORCE)
    path = PurePosixPath(row.file.replace("\\", "/"))
    # A capture is one folder that can be moved, sent and read by others, so nothing outside it belongs to it.
    if not path.parts or path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise row.error(
            "a path inside the capture folder", row.file, got=row.file or "nothing", name="file", advice="copy it there"
        )
    meters = settings.meters
    return Impact(str(path), (x * meters, y * meters, z * meters), direction, newtons, line=row.line)


def valid_rows(rows: Iterable[Row], settings: CaptureSettings) -> Iterator[Impact]:
    """Yield the rows that can be parsed."""
    for row in rows:
        with suppress(CaptureError):
            yield parse_row(row, settings)


@contextmanager
def in_folder(folder: Path) -> Iterator[None]:
    """Name the folder in a `CaptureError` whose files are named as in the folder."""
    try:
        yield
    except CaptureError as error:
        if str(error).startswith(str(folder)):
            raise
        named = folder if error.file is None else Path(error.file)
        file = named if named == folder or folder in named.parents else folder / named
        place = f"{file.parent}/" if str(error).startswith(file.name) else f"{folder}: "
        raise type(error)(f"{place}{error}", **{**error.attributes, "file": file}) from error


def read_impacts(folder: Path, settings: CaptureSettings) -> tuple[list[Impact], list[CaptureWarning]]:
    """Return the parsed rows of the folder's `impacts.csv`, and warnings of columns that are not used.

    Raises `CaptureError` as `read_rows` and `parse_row`, for two rows of one file, and where several are missing.
    """
    with in_folder(folder):
        rows, remarks = read_rows(folder)
        impacts = [parse_row(row, settings) for row in rows]
        check_files_differ(impacts)
        check_files_exist(folder, impacts)
    return impacts, remarks


def check_files_differ(impacts: Sequence[Impact]) -> None:
    """Raise `CaptureError` where two rows name one file: one of the two contacts must be wrong."""
    lines: dict[str, int] = {}
    for impact in impacts:
        if impact.file in lines:
            wanted, got = "a different recording for each row", f"{impact.file} as in row {lines[impact.file]}"
            raise CaptureError.expected(wanted, impact.file, got=got, file=TABLE, row=impact.line, name="file")
        lines[impact.file] = impact.line


def check_files_exist(folder: Path, impacts: Sequence[Impact]) -> None:
    """Raise one `CaptureError` where recordings are missing; for a single one with the file that may be meant."""
    files = [impact.file for impact in impacts]
    missing = [file for file in files if is_missing(folder / file)]
    if not missing:
        return
    unlisted = (path.relative_to(folder).as_posix() for path in reversed(files_in(folder)) if path.name in missing)
    below = {PurePosixPath(path).name: path for path in unlisted if path not in files}
    moved, single = next((file for file in missing if file in below), None), len(missing) == 1
    if single and moved is None:
        advice, used = f"copy it there, or remove its row from {TABLE}", {folder / each for each in files}
        raise missing_recording(folder / missing[0], missing[0], advice=advice, used=used)
    advice = f"write {below[moved]} in place of {moved}" if moved else "copy them there, or correct their names"
    got, value = (
        f"none for {len(missing)} of {len(impacts)} ({listed(missing)})",
        below[moved] if single and moved else missing,
    )
    path = folder / (missing[0] if single else TABLE)
    raise CaptureError.expected("a file for each row", value, got=got, file=path, name="file", advice=advice)


def is_missing(path: Path) -> bool:
    """Return whether nothing is at a path; a name that no file can have is left to the reader of sound files."""
    try:
        return not path.exists()
    except OSError:
        return False


def fitting_units(written: float) -> str:
    """Return advice with the units in which a coordinate would belong to an object of 1 cm to 5 m."""
    fitting = [(unit, written * size) for unit, size in METRES.items() if 0.01 <= written * size <= 5]
    if not fitting:
        return "no unit fits an object of 1 cm to 5 m, so correct the row"
    choices = " or ".join(f'unit = "{unit}" ({meters:.3g} m)' for unit, meters in fitting)
    return f"write the unit in capture.toml: {choices}"


def _check_header(header: Sequence[str], path: Path) -> list[CaptureWarning]:
    known = (*REQUIRED, *DIRECTION, FORCE)
    missing = [name for name in REQUIRED if name not in header]
    directions = [name for name in DIRECTION if name in header]
    double = sorted({name for name in header if name in known and header.count(name) > 1})
    if missing:
        numbers = "vertex numbers have to become positions: " if any("vert" in name for name in header) else ""
        wanted, name, advice = f"the columns {', '.join(missing)}", missing[0], numbers + HOW_TO_WRITE
        raise CaptureError.expected(
            wanted, list(header), got=f"only {', '.join(header)}", file=path, name=name, advice=advice
        )
    if 0 < len(directions) < 3:
        absent, got = next(name for name in DIRECTION if name not in header), f"only {', '.join(directions)}"
        raise CaptureError.expected("all of nx, ny, nz or none", directions, got=got, file=path, name=absent)
    if double:
        got = f"more than one {', '.join(double)}"
        raise CaptureError.expected("different names of columns", list(header), got=got, file=path, name=double[0])
    extra = [name or "(no name)" for name in header if name not in known]
    unused = CaptureWarning(f"{path}: columns that are not used: {', '.join(extra)}", file=path, value=extra)
    return [unused] if extra else []


def _number(row: Row, name: str) -> float:
    text = row.cells[name]
    try:
        # Spreadsheets of some languages write the typographic minus.
        plain = text.replace("\N{MINUS SIGN}", "-")
        value = float(plain.replace(",", ".") if row.decimal_comma else plain)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        advice = "separate the columns by semicolons where numbers have decimal commas" if "," in text else ""
        raise row.error(f"a number as {name}", text, name=name, advice=advice)
    return value
