"""A capture's `impacts.csv` as the page changes it: row by row, and all else stays as its owner has written it."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from avmsf._utils.files import write_whole
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import DIRECTION, FORCE, REQUIRED, TABLE, Row, read_cells
from avmsf.errors import CaptureError
from avmsf.studio.place import Place
from avmsf.studio.refusal import RefusedError

_LINE = re.compile(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+\Z")
"""One line with its end, as text files are read."""


@dataclass(frozen=True)
class StrikeTable:
    """The table of one capture folder, read again each time, because a spreadsheet may change it."""

    folder: Path

    @property
    def path(self) -> Path:
        """The file, which may not be there yet."""
        return self.folder / TABLE

    def rows(self) -> list[Row]:
        """Return the table's rows; empty without a table, or for one with only a header."""
        if not self.path.is_file():
            return []
        lines, separator = read_cells(self.path)
        if not lines:
            return []
        header = [name.lower() for name in lines[0][1]]
        lacking = [name for name in REQUIRED if name not in header]
        if lacking:
            raise CaptureError(
                f"{self.path}, row 1: expected the column {lacking[0]}, got {', '.join(header)}; correct the table, or "
                "move it away",
                file=self.path,
                row=1,
                name=lacking[0],
                value=header,
            )
        for line, cells in lines[1:]:
            if len(cells) != len(header):
                raise CaptureError.expected(
                    f"{len(header)} cells as in the header", len(cells), file=self.path, row=line
                )
        return [Row(line, dict(zip(header, cells, strict=True)), separator != ",") for line, cells in lines[1:]]

    def expect_room(self, place: Place) -> None:
        """Raise RefusedError (422) for an impact without a value that every row of the table has."""
        names = [name.lower() for name in self._header()]
        for column, value, what in ((DIRECTION[0], place.direction, "direction"), (FORCE, place.newtons, "force")):
            if column in names and value is None:
                raise RefusedError(
                    422,
                    f"{self.path}: expected a {what} as in all rows, got none; add it",
                    file=self.path,
                    name=what,
                )

    def add(self, file: str, place: Place, settings: CaptureSettings) -> None:
        """Append a row; a new table gets columns for the known values of the impact."""
        header = self._header()
        if not header:
            direction = () if place.direction is None else DIRECTION
            names = [*REQUIRED, *direction, *(() if place.newtons is None else (FORCE,))]
            self._write([_written(names, ",", "\n"), _written(_cells(names, file, place, settings), ",", "\n")])
            return
        mark, lines, separator = self._text()
        end = _ending(lines)
        cells = _cells([name.lower() for name in header], file, place, settings)
        if self._has_decimal_commas():
            cells = [cell if cell == file else cell.replace(".", ",") for cell in cells]
        if not lines[-1].endswith(("\r", "\n")):
            lines[-1] += end
        self._write([mark, *lines, _written(cells, separator, end)])

    def remove(self, file: str) -> None:
        """Remove a recording's row; the table is deleted with its last row."""
        mark, lines, separator = self._text()
        [(begin, end, _)] = self._records(lines, separator, file)
        if len(self.rows()) == 1:
            self.path.unlink()
        else:
            self._write([mark, *lines[:begin], *lines[end:]])

    def rename(self, file: str, new: str) -> None:
        """Let a recording's row name another file."""
        mark, lines, separator = self._text()
        [(begin, end, cells)] = self._records(lines, separator, file)
        cells[self._column()] = new
        self._write([mark, *lines[:begin], _written(cells, separator, _ending(lines)), *lines[end:]])

    def _header(self) -> list[str]:
        """Return the columns as their owner calls them; none where there is no table."""
        lines = read_cells(self.path)[0] if self.path.is_file() else []
        return lines[0][1] if lines else []

    def _column(self) -> int:
        return [name.lower() for name in self._header()].index(REQUIRED[0])

    def _text(self) -> tuple[str, list[str], str]:
        """Return the table's byte-order mark, its lines with their ends, and what separates its cells."""
        separator = read_cells(self.path)[1]
        text = self.path.read_bytes().decode()
        mark = text[: text.startswith("\ufeff")]
        return mark, _LINE.findall(text.removeprefix(mark)), separator

    def _records(self, lines: Sequence[str], separator: str, file: str) -> Iterator[tuple[int, int, list[str]]]:
        """Yield a recording's rows: the first line, the one after the last, and the cells."""
        column, begin, head = self._column(), 0, True
        reader = csv.reader(lines, delimiter=separator)
        for cells in reader:
            if any(cell.strip() for cell in cells):
                if not head and posix(cells[column].strip()) == file:
                    yield begin, reader.line_num, cells
                head = False
            begin = reader.line_num

    def _has_decimal_commas(self) -> bool:
        names = (*REQUIRED[1:], *DIRECTION, FORCE)
        return any("," in row.cells[name] for row in self.rows() for name in names if name in row.cells)

    def _write(self, parts: Sequence[str]) -> None:
        content = "".join(parts).encode()
        write_whole(self.path, lambda place: place.write_bytes(content), raising=CaptureError)


def file_of(row: Row) -> str:
    """Return the recording that a row names, as `understand` writes it."""
    return posix(row.cells[REQUIRED[0]])


def posix(text: str) -> str:
    """Return a path with forward slashes."""
    return str(PurePosixPath(text.replace("\\", "/")))


def _cells(names: Sequence[str], file: str, place: Place, settings: CaptureSettings) -> list[str]:
    """Return a row's cells, in the table's unit; unknown columns are empty."""
    values = dict(zip(REQUIRED[1:], (value / settings.meters for value in place.contact), strict=True))
    if place.direction is not None:
        length = math.hypot(*place.direction)
        values |= dict(zip(DIRECTION, (value / length for value in place.direction), strict=True))
    if place.newtons is not None:
        values[FORCE] = place.newtons
    written = {REQUIRED[0]: file} | {name: repr(float(value)) for name, value in values.items()}
    return [written.get(name, "") for name in names]


def _written(cells: Sequence[str], separator: str, end: str) -> str:
    memory = io.StringIO()
    csv.writer(memory, delimiter=separator, lineterminator=end).writerow(cells)
    return memory.getvalue()


def _ending(lines: Sequence[str]) -> str:
    """Return how a table's lines end."""
    first = lines[0]
    return first[len(first.rstrip("\r\n")) :] or "\n"
