"""`impacts.csv`: one row for each recording, with the contact and, where known, the impact's direction and force."""

import csv
import io
import math
import os
import re
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from avmsf._utils.files import is_lfs_pointer
from avmsf._utils.text import listed, read_text
from avmsf.capture.filenames import files_in, similar_name
from avmsf.capture.issues import Issues
from avmsf.capture.settings import METRES, OBJECT_SIZES, TABLE, CaptureSettings
from avmsf.errors import CaptureError, CaptureWarning

REQUIRED = ("file", "x", "y", "z")
DIRECTION = ("nx", "ny", "nz")
FORCE = "force_newtons"
MIN_FORCE_NEWTONS, MAX_FORCE_NEWTONS = 1e-6, 1e6
"""Peak forces that a row may give: from a grain of dust to the largest impact hammers (2e4 N) and beyond."""
FARTHEST = 100.0
"""Meters from the origin beyond which a contact must be in another unit."""
_DECIMAL_COMMAS = "separate the columns by semicolons where numbers have decimal commas"
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
    table: Path | str = TABLE
    """What errors call the table."""

    @property
    def file(self) -> str:
        """Name of the recording as it is written."""
        return self.cells["file"]

    def error(self, wanted: str, value: Any, *, name: str, got: str | None = None, advice: str = "") -> CaptureError:
        """Return an error about a value in this row."""
        return CaptureError.expected(wanted, value, got=got, file=self.table, row=self.line, name=name, advice=advice)

    def number(self, name: str) -> float:
        """Return the finite number in a column. Raises `CaptureError` for another text."""
        text = self.cells[name]
        try:
            # Spreadsheets of some languages write the typographic minus.
            plain = text.replace("\N{MINUS SIGN}", "-")
            value = float(plain.replace(",", ".") if self.decimal_comma else plain)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            advice = _DECIMAL_COMMAS if "," in text else ""
            raise self.error(f"a number as {name}", text, name=name, advice=advice)
        return value


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

    Raises `CaptureError` for a file that is no table of UTF-8 text.
    """
    if is_lfs_pointer(path):
        raise CaptureError.expected("a table", got="a Git LFS pointer", file=path, advice="run git lfs pull")
    try:
        # Blank lines in place of what are no rows, so that lines keep their numbers.
        text = _NO_ROW.sub(lambda found: "\n" * found[0].count("\n"), read_text(path))
        first = text.lstrip().split("\n", 1)[0]
        separator = max(",;\t", key=first.count)
        reader = csv.reader(io.StringIO(text), delimiter=separator)
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except UnicodeDecodeError as error:
        advice = "save it from the spreadsheet as 'CSV UTF-8'"
        raise CaptureError.expected("UTF-8 text", got="other bytes", file=path, advice=advice) from error
    except (OSError, ValueError, csv.Error) as error:
        raise CaptureError.expected("a table", got=f"a file that cannot be read: {error}", file=path) from error
    return [(line, cells) for line, cells in lines if any(cells)], separator


def read_table(
    path: Path, required: Sequence[str], optional: Sequence[str], *, advice: str, shown: Path | str | None = None
) -> tuple[list[Row], list[str]]:
    """Return the rows of a table, and the columns that are not used.

    Commas, semicolons and tabs separate; a byte-order mark, Windows line ends, blank lines, upper case and spaces in
    the header do no harm. Errors about rows call the table `shown`. `CaptureError` where there is no row, a column is
    missing or double, or a row is of another length than the header.
    """
    lines, separator = read_cells(path)
    if not lines:
        raise CaptureError.expected("a table", "", got="an empty file", file=path, advice=advice)
    (first, names), known = lines[0], (*required, *optional)
    header = [name.lower() for name in names]
    missing = [name for name in required if name not in header]
    double = sorted({name for name in header if name in known and header.count(name) > 1})
    if missing:
        numbers = "vertex numbers have to become positions: " if any("vert" in name for name in header) else ""
        wanted, got, advice = f"columns named {', '.join(missing)}", f"only {', '.join(header)}", numbers + advice
        raise CaptureError.expected(wanted, header, got=got, file=path, row=first, name=missing[0], advice=advice)
    if double:
        got, wanted = f"more than one {', '.join(double)}", "different names of columns"
        raise CaptureError.expected(wanted, header, got=got, file=path, row=first, name=double[0])
    rows = []
    for line, cells in lines[1:]:
        if len(cells) != len(header):
            wanted, got = f"{len(header)} cells as in the header", f"{len(cells)}: {separator.join(cells)}"
            name = header[len(cells)] if len(cells) < len(header) else None
            hint = _DECIMAL_COMMAS if name is None and separator == "," else ""
            raise CaptureError.expected(wanted, len(cells), got=got, file=path, row=line, name=name, advice=hint)
        rows.append(Row(line, dict(zip(header, cells, strict=True)), separator != ",", shown or path))
    if not rows:
        raise CaptureError.expected("rows below the header", 0, got="none", file=path, advice=advice)
    return rows, [name or "(no name)" for name in header if name not in known]


def read_rows(folder: Path) -> tuple[list[Row], list[CaptureWarning]]:
    """Read the rows of the folder's `impacts.csv`, and warnings of columns that are not used.

    `CaptureError` as `read_table`, where there is no table, and where one column of a direction is missing.
    """
    path = folder / TABLE
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "none"
        raise CaptureError.expected("a capture folder", got=kind, file=folder, advice="check the path")
    if not path.is_file():
        raise CaptureError.expected("a table", file=path, advice=HOW_TO_WRITE)
    rows, unused = read_table(path, REQUIRED, (*DIRECTION, FORCE), advice=HOW_TO_WRITE, shown=TABLE)
    directions = [name for name in DIRECTION if name in rows[0].cells]
    if 0 < len(directions) < 3:
        absent, got = next(name for name in DIRECTION if name not in directions), f"only {', '.join(directions)}"
        raise CaptureError.expected("all of nx, ny, nz or none", directions, got=got, file=path, name=absent)
    rows = [replace(row, cells={**row.cells, "file": _as_on_disk(folder, row.file)}) for row in rows]
    message = f"{path}: columns that are not used: {', '.join(unused)}"
    return rows, [CaptureWarning(message, file=path, value=unused)] if unused else []


def _as_on_disk(folder: Path, file: str) -> str:
    """Return the name of a file that exists and has the same letters, composed or decomposed; else the name given."""
    if file.isascii() or os.path.exists(folder / file):
        return file
    wanted = unicodedata.normalize("NFC", file.replace("\\", "/"))
    names = (path.relative_to(folder).as_posix() for path in files_in(folder))
    return next((name for name in names if unicodedata.normalize("NFC", name) == wanted), file)


def parse_row(row: Row, settings: CaptureSettings) -> Impact:
    """Turn one row into a contact in meters, a unit direction and a force; `CaptureError` names the row and value."""
    x, y, z = (row.number(name) * settings.meters for name in REQUIRED[1:])
    direction, newtons = None, None
    if DIRECTION[0] in row.cells:
        vector = [row.number(name) for name in DIRECTION]
        length = math.hypot(*vector)
        # What has unit length already stays as it is, so that writing and reading again changes no digit; 0 is unknown.
        scale = 1.0 if length == 0 or abs(length - 1) < 1e-6 else 1 / length
        direction = (vector[0] * scale, vector[1] * scale, vector[2] * scale)
    if FORCE in row.cells:
        newtons = row.number(FORCE)
        if not MIN_FORCE_NEWTONS <= newtons <= MAX_FORCE_NEWTONS:
            wanted = f"{FORCE}, a peak force, of {MIN_FORCE_NEWTONS:g} to {MAX_FORCE_NEWTONS:g} N"
            raise row.error(wanted, newtons, name=FORCE)
    path = PurePosixPath(row.file.replace("\\", "/"))
    # A capture is one folder that can be moved, sent and read by others, so nothing outside it belongs to it.
    if not is_inside(path):
        wanted, got = "a path inside the capture folder", row.file or "nothing"
        raise row.error(wanted, row.file, got=got, name="file", advice="copy it there")
    return Impact(str(path), (x, y, z), direction, newtons, line=row.line)


def parse_rows(rows: Iterable[Row], settings: CaptureSettings, issues: Issues) -> list[Impact]:
    """Return the rows that can be parsed; `issues` raise or collect the errors of the others."""
    impacts = []
    for row in rows:
        with issues.keep((row.file, row.line)):
            impacts.append(parse_row(row, settings))
    return impacts


def is_inside(path: PurePosixPath) -> bool:
    """Return whether a path names something that lies in the folder which it is taken from."""
    return bool(path.parts) and not (path.is_absolute() or ".." in path.parts or ":" in path.parts[0])


@contextmanager
def in_folder(folder: Path) -> Iterator[None]:
    """Name the folder in a `CaptureError` whose files are named as in the folder."""
    try:
        yield
    except CaptureError as error:
        if str(error).startswith(tuple(f"{folder}{end}" for end in ("/", ":", ","))):
            raise
        named = folder if error.file is None else Path(error.file)
        file = named if named == folder or folder in named.parents else folder / named
        place = f"{file.parent}/" if str(error).startswith(file.name) else f"{folder}: "
        raise type(error)(f"{place}{error}", **{**error.attributes, "file": file}) from error


def read_impacts(folder: Path, settings: CaptureSettings, issues: Issues) -> list[Impact]:
    """Return the rows of the folder's `impacts.csv` that can be used.

    `issues` raise or collect the errors of the others, and of two rows that name one file.
    """
    rows, warnings = read_rows(folder)
    issues.warnings += warnings
    impacts = parse_rows(rows, settings, issues)
    with issues.keep(*((each.file, each.line) for each in impacts if _extent(each) > FARTHEST)):
        check_distances(impacts, settings)
    impacts = [each for each in impacts if _extent(each) <= FARTHEST]
    with issues.keep():
        _check_files_differ(impacts)
    return impacts


def present_impacts(folder: Path, impacts: Sequence[Impact], issues: Issues) -> list[Impact]:
    """Return the impacts whose recordings exist; `issues` raise or collect the error of the others."""
    missing = dict.fromkeys(each.file for each in impacts if not os.path.exists(folder / each.file))
    if missing:
        with issues.keep(*((each.file, each.line) for each in impacts if each.file in missing)):
            raise _missing_error(folder, {each.file for each in impacts}, list(missing))
    return [each for each in impacts if each.file not in missing]


def _extent(impact: Impact) -> float:
    """Return the largest of a contact's coordinates in magnitude, meters."""
    return max(map(abs, impact.contact))


def check_distances(impacts: Sequence[Impact], settings: CaptureSettings) -> None:
    """Raise `CaptureError` for contacts too far from the origin, with the units in which they would not be."""
    far = [each for each in impacts if _extent(each) > FARTHEST]
    if far:
        worst, which = max(far, key=_extent), f", the farthest of {len(far)}" if len(far) > 1 else ""
        written = [value / settings.meters for value in worst.contact]
        got = f"({', '.join(f'{value:g}' for value in written)}) {settings.unit}{which}"
        wanted, advice = f"a contact within {FARTHEST:g} m of the origin", fitting_units(max(map(abs, written)))
        raise CaptureError.expected(wanted, written, got=got, file=TABLE, row=worst.line, name="unit", advice=advice)


def _check_files_differ(impacts: Sequence[Impact]) -> None:
    """Raise `CaptureError` where two rows name one file: one of the two contacts must be wrong."""
    lines: dict[str, int] = {}
    for impact in impacts:
        first = lines.setdefault(impact.file, impact.line)
        if first != impact.line:
            wanted, got = "a different recording for each row", f"{impact.file} as in row {first}"
            raise CaptureError.expected(wanted, impact.file, got=got, file=TABLE, row=impact.line, name="file")


def _missing_error(folder: Path, files: Collection[str], missing: Sequence[str]) -> CaptureError:
    """Return the error of recordings that do not exist, with the file that may be meant by one of them."""
    others = [name for path in files_in(folder) if (name := path.relative_to(folder).as_posix()) not in files]
    below = {PurePosixPath(name).name: name for name in reversed(others)}
    file, single = next((each for each in missing if each in below), missing[0]), len(missing) == 1
    near = below.get(file) or (similar_name(file, others) if single else None)
    advice = f"write {near} in place of {file}" if near else f"copy it there, or remove its row from {TABLE}"
    if single:
        return CaptureError.expected("a sound file", near, got="none", file=file, advice=advice)
    got = f"none for {len(missing)} of {len(files)} ({listed(missing)})"
    advice = advice if near else "copy them there, or correct their names"
    return CaptureError.expected("a file for each row", missing, got=got, file=TABLE, name="file", advice=advice)


def fitting_units(written: float) -> str:
    """Return advice with the units in which a coordinate would belong to an object of `OBJECT_SIZES`, 1 cm to 5 m."""
    low, high = OBJECT_SIZES
    fitting = [(unit, written * size) for unit, size in METRES.items() if low <= written * size <= high]
    if not fitting:
        return "no unit fits an object of 1 cm to 5 m, so correct the row"
    choices = " or ".join(f'unit = "{unit}" ({meters:.3g} m)' for unit, meters in fitting)
    return f"write the unit in capture.toml: {choices}"
