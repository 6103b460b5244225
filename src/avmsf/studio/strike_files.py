"""A capture's recordings on disk, and the note of what was written under which of the page's keys."""

import hashlib
import io
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from avmsf._utils.files import write_whole
from avmsf._utils.locks import write_lock
from avmsf._utils.text_files import read_json
from avmsf.capture.audio import Recording
from avmsf.errors import CaptureError, FolderInUseError
from avmsf.pipeline.config import CACHE
from avmsf.studio.refusal import RefusedError

JOURNAL, REMOVED = "studio.json", "removed"
"""In the capture's cache: what was written under which key, and the recordings that were redone or taken out."""
COMMAND = "avmsf studio"
"""What other processes wait for, in their messages."""
_WAIT = 10.0
"""Seconds to wait for another studio's change, which takes a fraction of one."""
WAV = ".wav"
_NUMBERED = re.compile(r"(\d{1,6})\.wav", re.IGNORECASE)
_KEPT_KEYS = 10_000


@dataclass(frozen=True)
class StrikeFiles:
    """The recordings of one capture folder, by the names that its table gives them."""

    folder: Path
    """Without links."""

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the table, the recordings and the keys against other studios.

        Raises RefusedError (503) if another one holds the lock for long; the page then sends the recording again.
        """
        with ExitStack() as held:
            try:
                held.enter_context(write_lock(self.folder / CACHE, "capture", command=COMMAND, wait=_WAIT))
            except FolderInUseError as error:
                raise RefusedError(
                    503, f"{error}, and try again; nothing was changed", file=error.file, value=error.value
                ) from error
            yield

    def readable(self, file: str) -> Path:
        """Return a recording's path. Raises RefusedError (404) for a link out of the folder."""
        path = (self.folder / file).resolve()
        if not path.is_relative_to(self.folder):
            raise RefusedError(
                404, f"{file}: expected a file in the capture folder, got one outside; copy it there", file=file
            )
        return path

    def own(self, file: str) -> Path:
        """Return the path of a recording to change. Raises RefusedError (409) for a link, or a path through one.

        The target of a link may belong to another impact or another capture.
        """
        path = self.folder / file
        if path.resolve() != path:
            raise RefusedError(
                409, f"{file}: expected a file, got a link; copy the file there first", file=file, value="link"
            )
        return path

    def digest(self, file: str) -> str | None:
        """Return a recording's digest; None if there is none."""
        path = self.readable(file)
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None

    def is_free(self, file: str) -> bool:
        """Whether no file has this name."""
        return not os.path.lexists(self.folder / file)

    def next_name(self, taken: Iterable[str]) -> str:
        """Return a number that no recording here has, and none of those `taken`."""
        names = [*(path.name for path in self.folder.iterdir()), *taken]
        numbers = [int(found[1]) for name in names if (found := _NUMBERED.fullmatch(name))]
        return f"{max(numbers, default=0) + 1:03d}{WAV}"

    def write(self, file: str, content: bytes, recording: Recording) -> None:
        """Write what was sent, to the last bit where it is a wav file, else the same samples as one."""
        if not (content[:4] == b"RIFF" and content[8:12] == b"WAVE"):
            memory = io.BytesIO()
            samples = recording.channels.T.astype(np.float32)
            soundfile.write(memory, samples, round(recording.sample_rate), subtype="FLOAT", format="WAV")
            content = memory.getvalue()
        write_whole(self.own(file), lambda place: place.write_bytes(content), raising=CaptureError)

    def set_aside(self, file: str) -> None:
        """Keep a recording in the cache too: by a hard link, which needs no space, or as a copy."""
        path = self.own(file)
        if not path.is_file():
            return
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()[:12]
        kept = self.folder / CACHE / REMOVED / f"{path.stem}-{digest}{path.suffix}"
        if kept.is_file():
            return
        try:
            kept.parent.mkdir(parents=True, exist_ok=True)
            os.link(path, kept)
        except OSError:
            write_whole(kept, lambda place: place.write_bytes(content), raising=CaptureError)

    def remove(self, file: str) -> None:
        """Remove a recording that is set aside and that no row names."""
        self.own(file).unlink(missing_ok=True)

    def journal(self) -> dict[str, dict[str, Any]]:
        """Return what was written by key; empty if the record is damaged."""
        try:
            known = read_json(self.folder / CACHE / JOURNAL)
        except (OSError, ValueError):
            return {}
        return known if isinstance(known, dict) else {}

    def write_journal(self, journal: Mapping[str, Any]) -> None:
        """Note what is about to be written, or was."""
        text = json.dumps(dict(list(journal.items())[-_KEPT_KEYS:]))
        path = self.folder / CACHE / JOURNAL
        write_whole(path, lambda place: place.write_text(text, encoding="utf-8"), raising=CaptureError)
