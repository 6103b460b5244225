"""Capture mode: strikes added to an ordinary capture folder, one recording at a time, each whole or not at all.

What the table holds is read anew for every request, so that a spreadsheet beside the page is no matter. A recording is
written before its row, and before both a note of what is about to be written, under the page's key: where the
connection breaks, or the server, the page sends it again and nothing is there twice.
"""

import csv
import hashlib
import io
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from threading import RLock
from typing import Any

import numpy as np
import soundfile

from avmsf.capture.audio import Recording, read_recording
from avmsf.capture.check import check
from avmsf.capture.folder import settings_of
from avmsf.capture.measure import RecordingReport, measure
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import DIRECTION, FARTHEST, FORCE, REQUIRED, TABLE, Row, Strike, read_cells, understand
from avmsf.errors import AvmsfError, CaptureError
from avmsf.files import write_whole
from avmsf.pipeline.reconstruct import CACHE
from avmsf.studio.locating import read_upload
from avmsf.studio.refusal import RefusedError

JOURNAL, REMOVED = "studio.json", "removed"
"""In the capture's cache: what was written under which key, and the recordings that were redone or taken out."""
_KEY = re.compile(r"[\x21-\x7e]{8,128}")
_NUMBERED = re.compile(r"(\d{1,6})\.wav", re.IGNORECASE)
_KEPT_KEYS = 10_000


@dataclass(frozen=True)
class Place:
    """Where a blow fell, as the page says it."""

    contact: tuple[float, float, float]
    """Object frame, metres."""
    direction: tuple[float, float, float] | None = None
    """Along which the hammer moved, into the object; any length but zero."""
    newtons: float | None = None
    """Peak force, where it is known."""

    @classmethod
    def read(cls, query: Mapping[str, str]) -> "Place":
        """Return the place of a request's query x, y, z, perhaps nx, ny, nz, newtons. Raises RefusedError (400)."""
        contact = _vector(query, REQUIRED[1:])
        if contact is None:
            raise RefusedError(400, "expected the contact as x, y and z in metres, found none: click the object first")
        if max(map(abs, contact)) > FARTHEST:
            raise RefusedError(400, f"expected a contact within {FARTHEST:g} m of the origin, found {contact}")
        direction = _vector(query, DIRECTION)
        if direction is not None and math.hypot(*direction) == 0:
            raise RefusedError(400, "nx, ny, nz: expected a direction, found the zero vector")
        newtons = None
        if "newtons" in query:
            newtons = _finite(query, "newtons")
            if newtons <= 0:
                raise RefusedError(400, f"newtons: expected a peak force above 0, found {newtons:g}")
        return cls(contact, direction, newtons)


class StrikeBook:
    """The strikes of one capture folder. Its methods may be called from any thread, and block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self._lock = RLock()
        self._measured: dict[tuple[object, ...], RecordingReport] = {}

    @property
    def settings(self) -> CaptureSettings:
        """The folder's capture.toml as it is now. Raises CaptureError."""
        return settings_of(self.folder)

    def describe(self) -> dict[str, Any]:
        """Return all strikes with what `avmsf check` would say of them, and what is wrong with the whole."""
        with self._lock:
            settings = self.settings
            rows = self._rows()
            strikes = [self._described(number, row, settings) for number, row in enumerate(rows)]
            problems: list[str] = []
            ready = False
            if len(rows) >= 2:
                report = check(self.folder)
                problems, ready = list(report.problems), report.readable
            return {"folder": str(self.folder), "strikes": strikes, "problems": problems, "ready": ready}

    def strikes(self) -> list[Strike]:
        """Return the strikes that can be understood and whose recordings are there, in the table's order."""
        found = []
        with self._lock:
            settings = self.settings
            for row in self._rows():
                try:
                    strike = understand(row, settings)
                except CaptureError:
                    continue
                path = (self.folder / strike.file).resolve()
                if path.is_relative_to(self.folder) and path.is_file():
                    found.append(strike)
        return found

    def judge(self, content: bytes) -> dict[str, Any]:
        """Return what a recording is worth, without writing it. Raises CaptureError for what cannot be used."""
        recording = read_upload(content)
        return _plain(self._expect_usable(recording, newtons=1.0)[0])

    def add(self, content: bytes, place: Place, *, key: str) -> dict[str, Any]:
        """Write a strike and return it; of what came under the same key before, return what was written then.

        Raises CaptureError for a recording that cannot be used, and RefusedError for a key that is none or was another
        strike's.
        """
        if not _KEY.fullmatch(key):
            raise RefusedError(
                400, "Idempotency-Key: expected 8 to 128 characters that belong to this strike alone: reload the page"
            )
        digest = hashlib.sha256(content + repr(place).encode()).hexdigest()
        with self._lock:
            journal = self._journal()
            known = journal.get(key)
            if known is not None and known["digest"] != digest:
                raise RefusedError(409, "this key was used for another strike: reload the page and record again")
            if known is not None and known.get("removed"):
                raise RefusedError(409, f"{known['file']} was taken out again: record it anew to have it back")
            if known is None or all(_file(row) != known["file"] for row in self._rows()):
                recording = read_upload(content)
                _, settings = self._expect_usable(recording, newtons=place.newtons)
                header, separator, lines = self._table(place)
                cells = _cells(header, place, settings)
                file = self._next_name() if known is None else known["file"]
                journal[key] = {"digest": digest, "file": file}
                self._write_journal(journal)
                self._write_recording(file, content, recording)
                named = [file if name == "file" else cells[name] for name in header]
                self._write_table([header, *lines, named], separator)
            file = journal[key]["file"]
            return self._found(file)

    def redo(self, file: str, content: bytes) -> dict[str, Any]:
        """Put another recording in a strike's place and return it; the one before is kept in the cache."""
        with self._lock:
            self._found(file)
            recording = read_upload(content)
            self._expect_usable(recording, newtons=1.0, beside=file)
            self._set_aside(file, keep=True)
            self._write_recording(file, content, recording)
            return self._found(file)

    def remove(self, file: str) -> None:
        """Take a strike out of the table; its recording is kept in the cache. Raises RefusedError (404)."""
        with self._lock:
            self._found(file)
            lines, separator = read_cells(self.folder / TABLE)
            header = [name.lower() for name in lines[0][1]]
            column = header.index("file")
            left = [cells for _, cells in lines[1:] if _posix(cells[column]) != file]
            if left:
                self._write_table([lines[0][1], *left], separator)
            else:
                (self.folder / TABLE).unlink()
            journal = self._journal()
            changed = {
                key: entry | {"removed": True} if entry["file"] == file else entry for key, entry in journal.items()
            }
            self._write_journal(changed)
            self._set_aside(file, keep=False)

    def _rows(self) -> list[Row]:
        """Return the table's rows; none where there is no table yet, or one with nothing but its header."""
        path = self.folder / TABLE
        if not path.is_file():
            return []
        lines, separator = read_cells(path)
        if not lines:
            return []
        header = [name.lower() for name in lines[0][1]]
        lacking = [name for name in REQUIRED if name not in header]
        if lacking:
            raise CaptureError(f"{path}: the column {lacking[0]} is missing: mend the table, or move it away")
        for line, cells in lines[1:]:
            if len(cells) != len(header):
                raise CaptureError(f"{TABLE} line {line}: {len(cells)} cells where the header has {len(header)}")
        return [Row(line, dict(zip(header, cells, strict=True)), separator != ",") for line, cells in lines[1:]]

    def _table(self, place: Place) -> tuple[list[str], str, list[list[str]]]:
        """Return the header that a new strike's row goes under, what separates its cells, and the rows so far."""
        path = self.folder / TABLE
        lines, separator = read_cells(path) if path.is_file() else ([], ",")
        if not lines:
            direction = () if place.direction is None else DIRECTION
            return [*REQUIRED, *direction, *(() if place.newtons is None else (FORCE,))], ",", []
        header = lines[0][1]
        names = [name.lower() for name in header]
        for column, value, what in ((DIRECTION[0], place.direction, "direction"), (FORCE, place.newtons, "force")):
            if column in names and value is None:
                raise RefusedError(422, f"{path}: every row has a {what} and this strike has none: give it one")
        return names, separator, [cells for _, cells in lines[1:]]

    def _described(self, number: int, row: Row, settings: CaptureSettings) -> dict[str, Any]:
        values: dict[str, Any] = {"row": number, "file": _file(row), "contact": None, "direction": None}
        try:
            strike = understand(row, settings)
            values |= {"file": strike.file, "contact": strike.contact, "direction": strike.direction}
            report = self._report(strike, settings)
        except AvmsfError as error:
            report = RecordingReport(values["file"], row.line, readable=False, problems=(str(error),))
        return {**_plain(report), **values}

    def _report(self, strike: Strike, settings: CaptureSettings) -> RecordingReport:
        path = self._inside(strike.file)
        state = path.stat() if path.is_file() else None
        key = (strike, settings, None if state is None else (state.st_mtime_ns, state.st_size, state.st_ino))
        if key not in self._measured:
            recording = read_recording(path, strike.file)
            prepared = prepare(recording, settings, newtons=strike.newtons)
            self._measured[key] = measure(recording, prepared, settings=settings, line=strike.line)
        return self._measured[key]

    def _found(self, file: str) -> dict[str, Any]:
        settings = self.settings
        for number, row in enumerate(self._rows()):
            if _file(row) == file:
                return self._described(number, row, settings)
        raise RefusedError(404, f"{file[:80]!r}: expected a recording of {TABLE}, found no such row: reload the page")

    def _expect_usable(
        self, recording: Recording, *, newtons: float | None, beside: str | None = None
    ) -> tuple[RecordingReport, CaptureSettings]:
        """Return a recording's report and the settings. Raises CaptureError for what would make the capture unreadable.

        `beside` is the recording whose place it takes.
        """
        settings = self.settings
        prepared = prepare(recording, settings, newtons=newtons)
        report = measure(recording, prepared, settings=settings, line=0)
        rates = []
        for row in self._rows():
            if _file(row) != beside:
                try:
                    with soundfile.SoundFile(self.folder / understand(row, settings).file) as other:
                        rates.append(float(other.samplerate))
                except (CaptureError, soundfile.LibsndfileError, OSError):
                    continue
        usual = max(set(rates), key=rates.count) if rates else recording.sample_rate
        if recording.sample_rate != usual:
            raise CaptureError(
                f"{recording.name}: expected {usual:g} Hz, as the {len(rates)} recordings before, found "
                f"{recording.sample_rate:g} Hz: record at that rate, or convert it"
            )
        return report, settings

    def _next_name(self) -> str:
        """Return a number that no recording here has, and none that was taken out had."""
        names = [path.name for path in self.folder.iterdir()]
        names += [_file(row) for row in self._rows()]
        names += [entry["file"] for entry in self._journal().values()]
        numbers = [int(found[1]) for name in names if (found := _NUMBERED.fullmatch(name))]
        return f"{max(numbers, default=0) + 1:03d}.wav"

    def _write_recording(self, file: str, content: bytes, recording: Recording) -> None:
        """Write what was sent, to the last bit where it is a wav file, else the same samples as one."""
        if not (content[:4] == b"RIFF" and content[8:12] == b"WAVE"):
            memory = io.BytesIO()
            samples = recording.channels.T.astype(np.float32)
            soundfile.write(memory, samples, round(recording.sample_rate), subtype="FLOAT", format="WAV")
            content = memory.getvalue()
        path = self._inside(file)
        write_whole(path, lambda place: place.write_bytes(content), raising=CaptureError)

    def _inside(self, file: str) -> Path:
        """Return a recording's path. Raises RefusedError (404) for one that leads out of the folder by a link."""
        path = (self.folder / file).resolve()
        if not path.is_relative_to(self.folder):
            raise RefusedError(404, f"{file}: lies outside the capture folder: copy it there")
        return path

    def _write_table(self, lines: Sequence[Sequence[str]], separator: str) -> None:
        memory = io.StringIO()
        csv.writer(memory, delimiter=separator, lineterminator="\n").writerows(lines)
        content = memory.getvalue().encode()
        write_whole(self.folder / TABLE, lambda place: place.write_bytes(content), raising=CaptureError)

    def _set_aside(self, file: str, *, keep: bool) -> None:
        """Keep a recording in the cache, and with `keep` where it is too, until another takes its place."""
        path = self._inside(file)
        if not path.is_file():
            return
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        kept = self.folder / CACHE / REMOVED / f"{path.stem}-{digest}.wav"
        content = path.read_bytes()
        write_whole(kept, lambda place: place.write_bytes(content), raising=CaptureError)
        if not keep:
            os.unlink(path)

    def _journal(self) -> dict[str, dict[str, Any]]:
        try:
            known = json.loads((self.folder / CACHE / JOURNAL).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return known if isinstance(known, dict) else {}

    def _write_journal(self, journal: Mapping[str, Any]) -> None:
        kept = dict(list(journal.items())[-_KEPT_KEYS:])
        text = json.dumps(kept)
        path = self.folder / CACHE / JOURNAL
        write_whole(path, lambda place: place.write_text(text, encoding="utf-8"), raising=CaptureError)


def _plain(report: RecordingReport) -> dict[str, Any]:
    """Return what the page shows of a recording."""
    names = ("readable", "seconds", "sample_rate", "channels", "coding", "peak_db", "noise_db", "onset_seconds")
    values = {name: getattr(report, name) for name in (*names, "clipped", "double_hit_seconds")}
    return {"file": report.file, **values, "warnings": list(report.problems)}


def _cells(header: Sequence[str], place: Place, settings: CaptureSettings) -> dict[str, str]:
    """Return a row's cells by column, in the table's unit; columns that nobody reads stay empty."""
    written = dict(zip(REQUIRED[1:], (value / settings.metres for value in place.contact), strict=True))
    if place.direction is not None:
        length = math.hypot(*place.direction)
        written |= dict(zip(DIRECTION, (value / length for value in place.direction), strict=True))
    if place.newtons is not None:
        written[FORCE] = place.newtons
    return {name: f"{written[name]:.17g}" if name in written else "" for name in header}


def _file(row: Row) -> str:
    return _posix(row.cells["file"])


def _posix(text: str) -> str:
    """Return a path as `understand` writes it."""
    return str(PurePosixPath(text.replace("\\", "/")))


def _vector(query: Mapping[str, str], names: Sequence[str]) -> tuple[float, float, float] | None:
    if not any(name in query for name in names):
        return None
    x, y, z = (_finite(query, name) for name in names)
    return (x, y, z)


def _finite(query: Mapping[str, str], name: str) -> float:
    try:
        value = float(query[name])
    except (KeyError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise RefusedError(400, f"{name}: expected a number, found {query.get(name, 'none')!r}")
    return value
