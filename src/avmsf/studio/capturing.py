"""Capture mode: impacts added to a capture folder, one recording at a time, each atomically.

The table is read again for every request, so that it can be edited in a spreadsheet at the same time, and changed under
a lock of the folder, so that two studios do not overwrite each other's changes. Before a recording and its row are
written, both are noted under the key of the page's request: if the connection or the server fails, the page repeats the
request, and nothing is written twice.
"""

import hashlib
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path, PurePosixPath
from threading import RLock
from typing import Any

import soundfile

from avmsf._utils.wording import counted
from avmsf.capture.audio import Recording
from avmsf.capture.measure import RecordingReport, measure
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings, settings_of
from avmsf.capture.table import TABLE, Row, Strike, understand
from avmsf.errors import AvmsfError, CaptureError
from avmsf.studio.judgements import Judgements, plain
from avmsf.studio.locating import read_upload
from avmsf.studio.place import Place
from avmsf.studio.refusal import RefusedError, bad_request
from avmsf.studio.strike_files import WAV, StrikeFiles
from avmsf.studio.strike_table import StrikeTable, file_of

_KEY = re.compile(r"[\x21-\x7e]{8,128}")


class StrikeBook:
    """The impacts of one capture folder. Its methods are thread-safe, and block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.table, self.files = StrikeTable(self.folder), StrikeFiles(self.folder)
        self.judgements = Judgements(self.files)
        self._lock = RLock()

    @property
    def settings(self) -> CaptureSettings:
        """The folder's capture.toml as it is now. Raises CaptureError."""
        return settings_of(self.folder)

    def describe(self) -> dict[str, Any]:
        """Return all impacts with their reports of `avmsf check`, and the problems of the whole capture."""
        with self._lock:
            settings = self.settings
            strikes = [self._described(number, row, settings) for number, row in enumerate(self.table.rows())]
        problems: list[str] = []
        ready = False
        if len(strikes) >= 2:
            report = self.judgements.whole(settings)
            problems, ready = list(report.problems), report.readable and all(each["readable"] for each in strikes)
        return {"folder": str(self.folder), "strikes": strikes, "problems": problems, "ready": ready}

    def strikes(self) -> list[Strike]:
        """Return the impacts that are valid and whose recordings exist, in the order of the table."""
        found = []
        with self._lock:
            settings = self.settings
            for row in self.table.rows():
                try:
                    strike = understand(row, settings)
                    present = self.files.readable(strike.file).is_file()
                except AvmsfError:
                    continue
                if present:
                    found.append(strike)
        return found

    def judge(self, content: bytes) -> dict[str, Any]:
        """Return what a recording is worth, without writing it. Raises CaptureError for what cannot be used."""
        recording = read_upload(content)
        return plain(self._expect_usable(recording, newtons=1.0)[0])

    def add(self, content: bytes, place: Place, *, key: str) -> dict[str, Any]:
        """Write an impact and return it; for a key that was written before, return that impact.

        Raises CaptureError for a recording that cannot be used, and RefusedError for an invalid key and for one of
        another impact.
        """
        _expect_key(key)
        digest = hashlib.sha256(content + repr(place).encode()).hexdigest()
        with self._lock, self.files.lock():
            journal = self.files.journal()
            known = journal.get(key)
            if known is not None and known["digest"] != digest:
                raise RefusedError(
                    409,
                    "Idempotency-Key: expected a new key, got that of another impact; reload the page and record again",
                    name="Idempotency-Key",
                    value=key,
                )
            if known is not None and self._is_taken_out(known):
                removed = known["file"]
                raise RefusedError(
                    409, f"{removed}: expected a recording, got a deleted one; record it again", file=removed
                )
            if known is None or not self._rows_of(known["file"]):
                recording = read_upload(content)
                _, settings = self._expect_usable(recording, newtons=place.newtons)
                self.table.expect_room(place)
                file = self._next_name() if known is None else known["file"]
                self.files.own(file)
                journal[key] = {"digest": digest, "file": file}
                self.files.write_journal(journal)
                self.files.write(file, content, recording)
                self.table.add(file, place, settings)
            return self._found(journal[key]["file"])

    def redo(self, file: str, content: bytes, *, key: str | None = None, match: str | None = None) -> dict[str, Any]:
        """Replace the recording of an impact and return the impact; the old recording is moved to the cache.

        The new file is a wav file whatever the old one was. A repeated request of the same `key` changes nothing.
        Raises RefusedError (409) if the digest of the recording is not `match`.
        """
        digest = hashlib.sha256(content + repr(file).encode()).hexdigest()
        with self._lock, self.files.lock():
            journal = self.files.journal()
            if key is not None:
                _expect_key(key)
                if key in journal and journal[key]["digest"] == digest and not self._is_taken_out(journal[key]):
                    return self._found(journal[key]["file"])
            self._expect_own(file, match)
            recording = read_upload(content)
            self._expect_usable(recording, newtons=1.0, beside=file)
            new = self._as_wav(file)
            self.files.set_aside(file)
            self.files.write(new, content, recording)
            if new != file:
                self.table.rename(file, new)
                self.files.remove(file)
            changed = {name: each | {"file": new} if each["file"] == file else each for name, each in journal.items()}
            if key is not None:
                changed[key] = {"digest": digest, "file": new}
            if changed != journal:
                self.files.write_journal(changed)
            return self._found(new)

    def remove(self, file: str, *, match: str | None = None) -> None:
        """Remove an impact from the table; its recording is moved to the cache.

        Raises RefusedError: 404 for no such impact, 409 if the digest of the recording is not `match`.
        """
        with self._lock, self.files.lock():
            self._expect_own(file, match)
            # All that needs space on the disk comes before the row goes.
            self.files.set_aside(file)
            journal = self.files.journal()
            gone = {key: each | {"removed": True} if each["file"] == file else each for key, each in journal.items()}
            self.files.write_journal(gone)
            try:
                self.table.remove(file)
            except BaseException:
                with suppress(CaptureError):
                    self.files.write_journal(journal)
                raise
            self.files.remove(file)

    def _described(self, number: int, row: Row, settings: CaptureSettings) -> dict[str, Any]:
        values: dict[str, Any] = {"row": number, "file": file_of(row), "contact": None, "direction": None}
        try:
            strike = understand(row, settings)
            values |= {"file": strike.file, "contact": strike.contact, "direction": strike.direction}
            report, digest = self.judgements.strike(strike, settings)
        except AvmsfError as error:
            report = RecordingReport(values["file"], row.line, readable=False, problems=(str(error),))
            digest = None
        return {**plain(report), **values, "digest": digest}

    def _found(self, file: str) -> dict[str, Any]:
        settings = self.settings
        for number, row in self._rows_of(file):
            return self._described(number, row, settings)
        raise RefusedError(
            404, f"{TABLE}: expected a row of {file[:80]!r}, got none; reload the page", file=TABLE, value=file
        )

    def _rows_of(self, file: str) -> list[tuple[int, Row]]:
        return [(number, row) for number, row in enumerate(self.table.rows()) if file_of(row) == file]

    def _is_taken_out(self, known: Mapping[str, Any]) -> bool:
        """Whether what was written under a key was removed; one whose row is there was not, as after a kill."""
        return bool(known.get("removed")) and not self._rows_of(known["file"])

    def _expect_own(self, file: str, match: str | None) -> None:
        """Raise RefusedError unless exactly one row has this recording, it is no link, and its digest is `match`."""
        self._found(file)
        lines = [row.line for _, row in self._rows_of(file)]
        if len(lines) > 1:
            raise RefusedError(
                409,
                f"{TABLE}, rows {', '.join(map(str, lines))}: expected one row of {file}, got {len(lines)}; correct "
                "the table",
                file=TABLE,
                row=lines[1],
                name=file,
                value=lines,
            )
        self.files.own(file)
        if match is not None and match != self.files.digest(file):
            raise RefusedError(
                409,
                f"{file}: expected the recording that the page shows, got another one from another tab or program; "
                "nothing was overwritten; play it and repeat the change",
                file=file,
                value=match,
            )

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
        for row in self.table.rows():
            if file_of(row) != beside:
                try:
                    with soundfile.SoundFile(self.files.readable(understand(row, settings).file)) as other:
                        rates.append(float(other.samplerate))
                except (AvmsfError, soundfile.LibsndfileError, OSError):
                    continue
        usual = max(set(rates), key=rates.count) if rates else recording.sample_rate
        if recording.sample_rate != usual:
            raise CaptureError(
                f"{recording.name}: expected {usual:g} Hz, as in the {counted(len(rates), 'recording')} before, got "
                f"{recording.sample_rate:g} Hz; record at that rate, or convert it",
                file=recording.name,
                name="sample_rate",
                value=recording.sample_rate,
            )
        return report, settings

    def _next_name(self) -> str:
        """Return a number that no recording here has, and none that was taken out had."""
        named = [file_of(row) for row in self.table.rows()]
        return self.files.next_name([*named, *(each["file"] for each in self.files.journal().values())])

    def _as_wav(self, file: str) -> str:
        """Return what a recording is called once it is a wav file."""
        path = PurePosixPath(file)
        if path.suffix.lower() == WAV:
            return file
        new = str(path.with_suffix(WAV))
        return new if self.files.is_free(new) and not self._rows_of(new) else self._next_name()


def _expect_key(key: str) -> None:
    if not _KEY.fullmatch(key):
        wanted = "8 to 128 printable ASCII characters"
        raise bad_request("Idempotency-Key", wanted, key, got="others", advice="reload the page")
