"""One writer at a time in a folder, whatever happens to the one before."""

import errno
import fcntl
import os
import pickle
import signal
import subprocess
import sys
import threading
from contextlib import nullcontext
from pathlib import Path

import pytest

from avmsf._utils.processes import NO_LIMIT, write_lock
from avmsf.errors import AvmsfError, FolderInUseError

HOLD = """
import sys
from pathlib import Path
from avmsf._utils.processes import write_lock
with write_lock(Path(sys.argv[1]), "stages", command="avmsf splat mug"):
    print("held", flush=True)
    sys.stdin.read()
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """Return a process that holds the lock of a folder until its standard input is closed."""
    command = [sys.executable, "-c", HOLD, str(folder)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_refused_and_hears_of_the_first(tmp_path: Path) -> None:
    with hold(tmp_path) as other:
        with pytest.raises(FolderInUseError) as refused, write_lock(tmp_path, "stages", command="me", wait=0.1):
            pytest.fail("two processes hold the lock")
        assert refused.value.value["command"] == "avmsf splat mug"
        assert refused.value.value["process"] == other.pid
        assert "since" in refused.value.value
        # Another lock of the folder is free.
        with write_lock(tmp_path, "capture", command="me", wait=0.0):
            pass
        other.communicate()
    with write_lock(tmp_path, "stages", command="me", wait=0.0):
        pass


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    with hold(tmp_path) as other:
        other.send_signal(signal.SIGKILL)
        other.wait()
        with write_lock(tmp_path, "stages", command="me", wait=0.0):
            pass


def test_who_waits_gets_the_lock_when_it_is_free(tmp_path: Path) -> None:
    with hold(tmp_path) as other:
        timer = threading.Timer(0.2, other.communicate)
        timer.start()
        with write_lock(tmp_path, "stages", command="me", wait=NO_LIMIT):
            timer.join()
            assert other.returncode == 0


def test_a_thread_takes_its_lock_again_and_another_one_does_not(tmp_path: Path) -> None:
    refused: list[FolderInUseError] = []

    def intrude() -> None:
        try:
            with write_lock(tmp_path, "stages", command="other", wait=0.1):
                pass
        except FolderInUseError as error:
            refused.append(error)

    with write_lock(tmp_path, "stages", command="me"):
        with write_lock(tmp_path, "stages", command="again", wait=0.0):
            pass
        thread = threading.Thread(target=intrude)
        thread.start()
        thread.join()
    assert [each.value["command"] for each in refused] == ["me"]


@pytest.mark.parametrize("missing", ["file/inside", "nowhere/inside"])
def test_where_nothing_can_be_written_there_is_no_lock_and_no_error(tmp_path: Path, missing: str) -> None:
    (tmp_path / "file").touch()
    with write_lock(tmp_path / missing, "stages", command="me"):
        pass
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("number", "writable", "held"),
    [
        (errno.EACCES, True, False),
        (errno.EACCES, False, True),
        (errno.EROFS, True, True),
        (errno.EMFILE, True, False),
        (errno.ENOSPC, True, False),
    ],
)
def test_only_where_nobody_can_write_a_lock_that_cannot_be_opened_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, writable: bool, held: bool
) -> None:
    def refuse(path: str, *rest: int, **named: int) -> int:
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(os, "access", lambda *arguments: writable)
    with nullcontext() if held else pytest.raises(AvmsfError), write_lock(tmp_path, "stages", command="me"):
        assert held


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_disk_without_locks_gets_no_file_that_outlives_its_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with write_lock(tmp_path, "stages", command="me"):
        # A lock by a file's existence would stay after a kill, and let nobody else in.
        monkeypatch.undo()
        with hold(tmp_path) as other:
            other.communicate()


def test_a_refusal_can_be_sent_between_processes() -> None:
    error = FolderInUseError.expected("a free folder", {"command": "avmsf splat"}, file=Path("mug"))
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.attributes) == (str(error), error.attributes)
