"""Processes beside each other: one writer at a time in a shared folder, and children that end with their parent.

The lock of a folder is `flock` on a file that stays there: the system releases it when its process ends, by `kill -9`
too. A second file says for people who holds it, and means nothing while the lock is free. Children end, on every
system, when the pipe to their standard input closes.
"""

import errno
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from avmsf._utils.files import write_whole
from avmsf._utils.text import read_json_object
from avmsf.errors import AvmsfError, FolderInUseError

WAIT = 3.0
"""Seconds that a command waits for another writer: longer than a page's change to a capture, shorter than a stage."""
NO_LIMIT = -1.0
"""The `wait` that lasts until the lock is free: a program that was killed holds none."""
_NO_PLACE = (errno.EROFS, errno.ENOENT, errno.ENOTDIR)
"""Errors of a folder that nobody can write to."""
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
"""Errors of a disk that has no locks."""
_RUNNING: set["subprocess.Popen[bytes]"] = set()


@contextmanager
def write_lock(
    folder: Path, name: str, *, command: str, wait: float = WAIT, advice: str = "", parents: bool = False
) -> Iterator[None]:
    """Let no other process, and no other thread, hold the lock `name` of a folder meanwhile.

    The folder is made where it is missing, and with `parents` those that it lies in. The same thread may take the lock
    again within. A folder that cannot be written to, where each write fails with its own error, and one on a disk
    without locks are used without a lock. `command` names what others wait for.

    Raises FolderInUseError where the lock is not free within `wait` seconds; `advice` ends its sentence. Raises
    AvmsfError where the folder can be written to and the lock cannot be had.
    """
    folder = folder.resolve()
    path, named = folder / f"{name}.lock", folder / f"{name}.lock.json"
    try:
        folder.mkdir(parents=parents, exist_ok=True)
        # One object for each path makes the lock reentrant within a thread.
        lock = FileLock(path, is_singleton=True, fallback_to_soft=False)
        lock.acquire(timeout=wait)
    except Timeout as error:
        holder, wanted = dict[str, Any](), "a folder that no other process writes to"
        with suppress(AvmsfError):
            holder = read_json_object(named, raising=AvmsfError)
        got = ", ".join(f"{name} {value}" for name, value in holder.items()) or "one that does not say its name"
        advice = f"wait until it has ended{advice}"
        raise FolderInUseError.expected(wanted, holder, got=got, file=folder, advice=advice) from error
    except OSError as error:
        _expect_excused(error, path)
        yield
        return
    outermost = lock.lock_counter == 1
    try:
        if outermost:
            since = datetime.now().astimezone().isoformat(timespec="seconds")
            # The lock holds without it, as where the disk is full.
            with suppress(AvmsfError):
                write_whole(named, json.dumps({"command": command, "process": os.getpid(), "since": since}))
        yield
    finally:
        if outermost:
            with suppress(OSError):
                named.unlink(missing_ok=True)
        lock.release()


def _expect_excused(error: OSError, path: Path) -> None:
    """Raise AvmsfError unless nobody can write to the lock's folder, or its disk has no locks."""
    denied = error.errno in (errno.EACCES, errno.EPERM)
    if error.errno in (*_NO_PLACE, *_NO_LOCKS) or (denied and not os.access(path.parent, os.W_OK)):
        return
    advice = "delete it if no process uses the folder" if denied else "choose another folder"
    raise AvmsfError.expected("a lock", error.strerror or str(error), file=path, advice=advice) from error


@contextmanager
def child_process(command: Sequence[str], **settings: Any) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a process that ends with the context or by `end_with_parent`; `settings` are Popen's. Raises OSError."""
    with subprocess.Popen(command, stdin=subprocess.PIPE, **settings) as process:
        _RUNNING.add(process)
        try:
            yield process
        finally:
            process.kill()
            _RUNNING.discard(process)


def _end_of_input() -> None:
    while sys.stdin.buffer.read(1):
        pass


def end_with_parent(wait: Callable[[], object] = _end_of_input) -> None:
    """Wait for the parent's end, by default for that of the standard input; end this process and what it started."""
    wait()
    for process in _RUNNING.copy():
        process.kill()
    os._exit(1)


def ending_of(status: int) -> str:
    """Return what ended a process: the name of a signal, or the exit status."""
    if status >= 0:
        return f"exit status {status}"
    names = {each.value: each.name for each in signal.Signals}
    return names.get(-status, f"signal {-status}")
