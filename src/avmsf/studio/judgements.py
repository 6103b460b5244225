"""Reports of `avmsf check` on recordings and captures, cached until a file changes."""

import os
from pathlib import Path
from threading import RLock
from typing import Any

from avmsf.capture.audio import read_recording
from avmsf.capture.check import CaptureReport, check
from avmsf.capture.measure import RecordingReport, measure
from avmsf.capture.prepare import prepare
from avmsf.capture.settings import CaptureSettings
from avmsf.capture.table import Strike
from avmsf.studio.strike_files import StrikeFiles


class Judgements:
    """The reports on one capture folder. Its methods may be called from any thread, and block."""

    def __init__(self, files: StrikeFiles) -> None:
        self.files = files
        self._strikes: dict[str, tuple[object, RecordingReport, str | None]] = {}
        self._whole: tuple[object, CaptureReport] | None = None
        self._lock = RLock()

    def strike(self, strike: Strike, settings: CaptureSettings) -> tuple[RecordingReport, str | None]:
        """Return the report on an impact's recording, and its digest. Raises AvmsfError for an unreadable one."""
        path = self.files.readable(strike.file)
        state = (strike, settings, _state(path))
        known = self._strikes.get(strike.file)
        if known is None or known[0] != state:
            recording = read_recording(path, strike.file)
            prepared = prepare(recording, settings, newtons=strike.newtons)
            report = measure(recording, prepared, settings=settings, line=strike.line)
            self._strikes[strike.file] = known = (state, report, self.files.digest(strike.file))
        return known[1], known[2]

    def whole(self, settings: CaptureSettings) -> CaptureReport:
        """Return the report on the folder, for which every recording is read once more."""
        with self._lock:
            state = (settings, tuple(_states(self.files.folder)))
            if self._whole is None or self._whole[0] != state:
                self._whole = (state, check(self.files.folder, settings))
            return self._whole[1]


def plain(report: RecordingReport) -> dict[str, Any]:
    """Return what the page shows of a recording."""
    names = ("readable", "seconds", "sample_rate", "channels", "coding", "peak_db", "noise_db", "onset_seconds")
    values = {name: getattr(report, name) for name in (*names, "clipped", "double_hit_seconds")}
    return {"file": report.file, **values, "warnings": list(report.problems)}


def _state(path: Path) -> tuple[int, int, int] | None:
    """Return what changes where a file does; None for none."""
    try:
        state = path.stat()
    except OSError:
        return None
    return state.st_mtime_ns, state.st_size, state.st_ino


def _states(folder: Path) -> list[tuple[str, object]]:
    """Return the states of all files of a folder but those of hidden ones, which are not the capture's."""
    found: list[tuple[str, object]] = []
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [(os.path.join(place, name), _state(Path(place, name))) for name in sorted(names)]
    return found
