"""Advisory locks: one writer at a time in a folder that several processes share.

The lock is `flock` on a file that stays in the folder, so the system releases it when its process ends, by `kill -9`
too. A second file says for people who holds it; it means nothing while the lock is free.
"""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from avmsf._utils.text_files import read_json
from avmsf.errors import AvmsfError, FolderInUseError
from avmsf.files import write_whole

WAIT = 3.0
"""Seconds that a command waits for another writer: longer than a page's change to a capture, shorter than a stage."""


@contextmanager
def write_lock(
    folder: Path, name: str, *, command: str, wait: float = WAIT, advice: str = "", parents: bool = False
) -> Iterator[None]:
    """Let no other process, and no other thread, hold the lock `name` of a folder meanwhile.

    The folder is made where it is missing, and with `parents` those that it lies in. The same thread may take the lock
    again within. A folder that cannot be written to, or a disk without locks, is used without a lock: each write there
    fails with its own error. `command` is what others are told to wait for.

    Raises FolderInUseError where the lock is not free within `wait` seconds; `advice` ends its sentence.
    """
    folder = folder.resolve()
    path = folder / f"{name}.lock"
    try:
        folder.mkdir(parents=parents, exist_ok=True)
        # One object for each path makes the lock reentrant within a thread.
        lock = FileLock(path, is_singleton=True)
        lock.acquire(timeout=wait)
    except Timeout as error:
        raise FolderInUseError(folder, _read_holder(path), advice) from error
    except (OSError, NotImplementedError):
        yield
        return
    try:
        outermost = lock.lock_counter == 1
        if outermost:
            _write_holder(path, command)
        try:
            yield
        finally:
            if outermost:
                with suppress(OSError):
                    _holder_of(path).unlink(missing_ok=True)
    finally:
        lock.release()


def _holder_of(path: Path) -> Path:
    return path.with_suffix(".lock.json")


def _write_holder(path: Path, command: str) -> None:
    since = datetime.now().astimezone().isoformat(timespec="seconds")
    words = json.dumps({"command": command, "process": os.getpid(), "since": since})
    # The lock holds without it, as where the disk is full.
    with suppress(AvmsfError):
        write_whole(_holder_of(path), lambda place: place.write_text(words, encoding="utf-8"))


def _read_holder(path: Path) -> dict[str, object]:
    """Return who holds a lock; nothing where the holder could not say so."""
    try:
        known = read_json(_holder_of(path))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}
