"""Capture mode: impacts added to a capture folder, one recording at a time, each atomically.

The table is read again for every request, because a spreadsheet may change it, and changed under a lock of the folder,
so that two studios do not overwrite each other's changes. A request that is repeated because its answer was lost finds
its recording in the folder, and writes nothing twice.
"""

import csv
import hashlib
import io
import math
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from functools import lru_cache, partial
from pathlib import Path, PurePosixPath
from typing import Any

from avmsf._utils.files import copy_whole, write_whole
from avmsf._utils.processes import write_lock
from avmsf._utils.text import counted
from avmsf.capture.audio import Recording, SoundBytes, decode_recording, read_recording, wav_bytes
from avmsf.capture.folder import check
from avmsf.capture.issues import RecordingReport
from avmsf.capture.measure import measure
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import TABLE, CaptureSettings, settings_of
from avmsf.capture.table import (
    DIRECTION,
    FORCE,
    REQUIRED,
    Impact,
    Row,
    check_distances,
    parse_row,
    read_cells,
    read_rows,
)
from avmsf.errors import AvmsfError, CaptureError
from avmsf.pipeline.config import CACHE
from avmsf.studio.responses import RequestError, bad_request

COMMAND = "avmsf studio"
"""What other processes wait for, in their messages."""
_NUMBERED = re.compile(r"(\d{1,6})\.wav", re.IGNORECASE)


def read_contact(query: Mapping[str, str]) -> Impact:
    """Return the contact, meters, of a query x, y, z, with the direction nx, ny, nz if given.

    Raises RequestError (400).
    """
    names = (*REQUIRED[1:], *(DIRECTION if any(name in query for name in DIRECTION) else ()))
    cells = {REQUIRED[0]: "recording", **{name: query.get(name, "") for name in names}}
    try:
        impact = parse_row(Row(0, cells, decimal_comma=False), CaptureSettings())
        check_distances([impact], CaptureSettings())
    except CaptureError as error:
        message = f"contact: {str(error).partition(': ')[2][:200]}; click the object"
        raise RequestError(400, message, name=error.name, value=error.value) from error
    return impact


def read_upload(content: bytes) -> Recording:
    """Return a recording that the page has sent.

    Raises CaptureError for a file that is no sound, and for one of excessive length: compressed silence of hours takes
    a few bytes.
    """
    return decode_recording(SoundBytes(content), "the recording")


class ImpactTable:
    """A capture's `impacts.csv` as it is now. A change leaves all other rows to the last byte."""

    def __init__(self, folder: Path) -> None:
        """Read the table; a folder without one has no rows. Raises CaptureError."""
        self.path = folder / TABLE
        lines, self.separator = read_cells(self.path) if self.path.is_file() else ([], ",")
        self.names = [name.lower() for name in lines[0][1]] if lines else []
        self.rows: list[Row] = read_rows(folder)[0] if lines[1:] else []
        missing = [name for name in REQUIRED if lines and name not in self.names]
        if missing:
            raise CaptureError.expected(f"the column {missing[0]}", file=self.path, row=1, name=missing[0])
        self._ends = [number for number, _ in lines]
        self._cells = [cells for _, cells in lines]
        text = self.path.read_bytes().decode() if lines else ""
        self._lines = list(io.StringIO(text, newline=""))

    def rows_of(self, file: str) -> list[int]:
        """Return the indices of the rows with this recording. Raises RequestError (404) for none."""
        indices = [index for index, row in enumerate(self.rows) if file_of(row) == file]
        if not indices:
            wanted = f"a row of {file[:80]!r}"
            raise bad_request("file", wanted, file, got="none", advice="reload the page", status=404, file=TABLE)
        return indices

    def add(self, file: str, impact: Impact, settings: CaptureSettings) -> None:
        """Append a row in the table's unit; a new table gets columns for the known values of the impact."""
        numbers = dict(zip(REQUIRED[1:], (value / settings.meters for value in impact.contact), strict=True))
        if impact.direction is not None:
            numbers |= dict(zip(DIRECTION, impact.direction, strict=True))
        header = [] if self.names else [self._line([REQUIRED[0], *numbers])]
        written = {name: repr(float(value)) for name, value in numbers.items()}
        if any("," in row.cells.get(name, "") for row in self.rows for name in (*REQUIRED[1:], *DIRECTION, FORCE)):
            written = {name: text.replace(".", ",") for name, text in written.items()}
        written[REQUIRED[0]] = file
        row = self._line([written.get(name, "") for name in self.names or (REQUIRED[0], *numbers)])
        if self._lines and not self._lines[-1].endswith(("\r", "\n")):
            row = self._line([]) + row
        self._write([*self._lines, *header, row])

    def rename(self, index: int, file: str) -> None:
        """Let a row name another recording."""
        cells = [*self._cells[index + 1]]
        cells[self.names.index(REQUIRED[0])] = file
        self._replace(index, [self._line(cells)])

    def remove(self, index: int) -> None:
        """Remove a row; the table is deleted with its last row."""
        if len(self.rows) == 1:
            self.path.unlink()
        else:
            self._replace(index, [])

    def _replace(self, index: int, lines: Sequence[str]) -> None:
        """Write the table with these lines in place of those of a row, whose cells may have several."""
        begin, end = self._ends[index], self._ends[index + 1]
        self._write([*self._lines[:begin], *lines, *self._lines[end:]])

    def _line(self, cells: Sequence[str]) -> str:
        memory, ending = io.StringIO(), "\r\n" if any(line.endswith("\r\n") for line in self._lines) else "\n"
        csv.writer(memory, delimiter=self.separator, lineterminator=ending).writerow(cells)
        return memory.getvalue()

    def _write(self, lines: Sequence[str]) -> None:
        write_whole(self.path, "".join(lines).encode(), raising=CaptureError)


def file_of(row: Row) -> str:
    """Return the recording that a row names, with forward slashes."""
    return str(PurePosixPath(row.cells[REQUIRED[0]].replace("\\", "/")))


class CaptureEditor:
    """The impacts of one capture folder. Its methods are thread-safe, and block."""

    def __init__(self, folder: Path, *, lock_seconds: float = 10.0) -> None:
        """Edit the folder; a change waits `lock_seconds` for another studio's, which takes a fraction of a second."""
        self.folder, self.lock_seconds = folder.resolve(), lock_seconds

    @property
    def settings(self) -> CaptureSettings:
        """The folder's capture.toml as it is now. Raises CaptureError."""
        return settings_of(self.folder)

    def describe(self) -> dict[str, Any]:
        """Return all impacts, and the problems of the whole capture as `avmsf check` finds them."""
        impacts, problems, ready = self.impacts(), list[str](), False
        if len(impacts) >= 2:
            report = check(self.folder, self.settings)
            problems, ready = list(report.problems), report.readable and all(each["readable"] for each in impacts)
        return {"folder": str(self.folder), "strikes": impacts, "problems": problems, "ready": ready}

    def impacts(self) -> list[dict[str, Any]]:
        """Return all impacts with their reports of `avmsf check`; only those that can be used have a digest."""
        settings = self.settings
        return [self._described(index, row, settings) for index, row in enumerate(ImpactTable(self.folder).rows)]

    def check(self, content: bytes) -> dict[str, Any]:
        """Return the report on a recording, without writing it. Raises CaptureError for what cannot be used."""
        return _plain(self._check_usable(read_upload(content), newtons=1.0))

    def add(self, content: bytes, impact: Impact) -> dict[str, Any]:
        """Write the recording of an impact and return it; one of the same recording and contact is returned as it is.

        In a table of directions an unknown one is zero. Raises CaptureError for a recording that cannot be used, and
        RequestError (422) where every row of the table has a force.
        """
        with self._lock():
            settings, table, recording = self.settings, ImpactTable(self.folder), read_upload(content)
            content = _as_wav(content, recording)
            for added in self.impacts():
                # Contacts are equal but for the conversion of units.
                if added["digest"] == _digest(content) and math.dist(added["contact"], impact.contact) < 1e-9:
                    return added
            self._check_usable(recording, newtons=None)
            if FORCE in table.names:
                wanted = "a force as in all rows"
                raise bad_request("force", wanted, got="none", advice="add it", status=422, file=table.path)
            if impact.direction is None and DIRECTION[0] in table.names:
                impact = replace(impact, direction=(0.0, 0.0, 0.0))
            file = self._next_name(table)
            write_whole(self.folder / file, content, raising=CaptureError)
            try:
                table.add(file, impact, settings)
            except BaseException:
                (self.folder / file).unlink(missing_ok=True)
                raise
            return self._found(file)

    def redo(self, file: str, content: bytes, *, match: str | None = None) -> dict[str, Any]:
        """Replace the recording of an impact and return the impact; the old recording is moved to the cache.

        The new file is a wav file whatever the old one was. A repeated request changes nothing. Raises RequestError
        (409) if the digest of the recording is not `match`.
        """
        with self._lock():
            recording = read_upload(content)
            content = _as_wav(content, recording)
            if (found := self._found(file))["digest"] == _digest(content):
                return found
            table, index = self._owned(file, match)
            self._check_usable(recording, newtons=1.0, replaced=file)
            new = str(PurePosixPath(file).with_suffix(".wav"))
            if PurePosixPath(file).suffix.lower() == ".wav":
                new = file
            elif os.path.lexists(self.folder / new) or new in map(file_of, table.rows):
                new = self._next_name(table)
            self._set_aside(file)
            write_whole(self.folder / new, content, raising=CaptureError)
            if new != file:
                table.rename(index, new)
                (self.folder / file).unlink(missing_ok=True)
            return self._found(new)

    def remove(self, file: str, *, match: str | None = None) -> None:
        """Remove an impact from the table; its recording is moved to the cache.

        Raises RequestError: 404 for no such impact, 409 if the digest of the recording is not `match`.
        """
        with self._lock():
            table, index = self._owned(file, match)
            # All that needs space on the disk comes before the row goes.
            self._set_aside(file)
            table.remove(index)
            (self.folder / file).unlink(missing_ok=True)

    def _lock(self) -> AbstractContextManager[None]:
        """Lock the table and the recordings against other studios. Raises FolderInUseError after some seconds."""
        wait, advice = self.lock_seconds, ", and try again"
        return write_lock(self.folder / CACHE, "capture", command=COMMAND, wait=wait, advice=advice)

    def _described(self, index: int, row: Row, settings: CaptureSettings) -> dict[str, Any]:
        values: dict[str, Any] = {"row": index, "file": file_of(row), "contact": None, "direction": None}
        digest = None
        try:
            impact = parse_row(row, settings)
            check_distances([impact], settings)
            values |= {"file": impact.file, "contact": impact.contact, "direction": impact.direction}
            path = (self.folder / impact.file).resolve()
            if not path.is_relative_to(self.folder):
                wanted, advice = "a file in the capture folder", "copy it there"
                raise CaptureError.expected(wanted, got="a link out of it", file=impact.file, advice=advice)
            state = path.stat() if os.path.exists(path) else None
            changing = state and (state.st_mtime_ns, state.st_size, state.st_ino)
            report, digest = _measured(path, changing, impact, settings)
        except AvmsfError as error:
            report = RecordingReport(values["file"], row.line, readable=False, problems=(str(error),))
        return {**_plain(report), **values, "digest": digest}

    def _found(self, file: str) -> dict[str, Any]:
        """Return an impact as `describe` does. Raises RequestError (404)."""
        index = ImpactTable(self.folder).rows_of(file)[0]
        return self.impacts()[index]

    def _owned(self, file: str, match: str | None) -> tuple[ImpactTable, int]:
        """Return the table and the row of a recording to change.

        Raises RequestError: 404 for an unknown one; 409 unless it has one row, is no link and has the digest `match`.
        """
        table = ImpactTable(self.folder)
        indices = table.rows_of(file)
        conflict = partial(bad_request, status=409)
        if len(indices) > 1:
            lines = [table.rows[index].line for index in indices]
            got, advice = f"rows {', '.join(map(str, lines))}", "correct the table"
            raise conflict(file, f"one row of {file}", lines, got=got, advice=advice, file=TABLE)
        path = self.folder / file
        # What a link leads to may belong to another impact or capture.
        if path.resolve() != path:
            raise conflict("file", "a file", "link", got="a link", advice="copy the file there first", file=file)
        if match is not None and not (path.is_file() and match == _digest(path.read_bytes())):
            wanted, got = "the recording that the page shows", "another one from another tab or program"
            advice = "nothing was overwritten; play it and repeat the change"
            raise conflict("digest", wanted, match, got=got, advice=advice, file=file)
        return table, indices[0]

    def _check_usable(
        self, recording: Recording, *, newtons: float | None, replaced: str | None = None
    ) -> RecordingReport:
        """Return a recording's report. Raises CaptureError for what would make the capture unreadable.

        `replaced` is the recording that it takes the place of.
        """
        report = _report(recording, self.settings, newtons=newtons)
        rates = [each["sample_rate"] for each in self.impacts() if each["digest"] and each["file"] != replaced]
        common_rate = max(set(rates), key=rates.count) if rates else recording.sample_rate
        if recording.sample_rate != common_rate:
            wanted = f"{common_rate:g} Hz, as in the {counted(len(rates), 'recording')} before"
            advice = "record at that rate, or convert it"
            rate, name = recording.sample_rate, recording.name
            raise CaptureError.expected(wanted, rate, file=name, name="sample_rate", advice=advice)
        return report

    def _next_name(self, table: ImpactTable) -> str:
        """Return a number that no recording here has, nor a row of the table."""
        names = [*(path.name for path in self.folder.iterdir()), *map(file_of, table.rows)]
        numbers = [int(found[1]) for name in names if (found := _NUMBERED.fullmatch(name))]
        return f"{max(numbers, default=0) + 1:03d}.wav"

    def _set_aside(self, file: str) -> None:
        """Keep a copy of a recording in the cache's folder of what was replaced or removed."""
        path = self.folder / file
        if path.is_file():
            name = f"{path.stem}-{_digest(path.read_bytes())[:12]}{path.suffix}"
            copy_whole(path, self.folder / CACHE / "removed" / name, raising=CaptureError)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _as_wav(content: bytes, recording: Recording) -> bytes:
    """Return what was sent, to the last bit where it is a wav file, else the same samples as one."""
    if content[:4] == b"RIFF" and content[8:12] == b"WAVE":
        return content
    return wav_bytes(recording.channels.T, round(recording.sample_rate))


def _plain(report: RecordingReport) -> dict[str, Any]:
    """Return what the page shows of a recording."""
    values = asdict(report)
    del values["line"]
    return {**values, "warnings": list(values.pop("problems"))}


def _report(
    recording: Recording, settings: CaptureSettings, *, newtons: float | None, line: int = 0
) -> RecordingReport:
    return measure(recording, prepare(recording, settings, newtons=newtons), settings=settings, line=line)


@lru_cache(maxsize=4096)
def _measured(path: Path, state: object, impact: Impact, settings: CaptureSettings) -> tuple[RecordingReport, str]:
    """Return the report on an impact's recording, and its digest. Raises CaptureError for an unreadable one."""
    recording = read_recording(path, impact.file)
    report = _report(recording, settings, newtons=impact.newtons, line=impact.line)
    return report, _digest(path.read_bytes())
