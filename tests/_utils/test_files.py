"""Files that cannot be written, and one writer at a time in a folder, whatever happens to the one before."""

import errno
import fcntl
import os
import resource
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import pytest

from avmsf._utils.files import new_folder, write_whole
from avmsf._utils.processes import NO_LIMIT, write_lock
from avmsf.errors import AvmsfError, ExportError, FolderInUseError
from avmsf.export.writing import write_folder
from factories.raising import raises


def test_a_file_in_a_folders_place_and_a_folder_in_a_files_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name, number in (("file/new", errno.EEXIST), ("file/deep/new", errno.ENOTDIR), ("folder", errno.EISDIR)):
        with raises(ExportError, file=tmp_path / name, value=os.strerror(number)):
            write_whole(tmp_path / name, b"", raising=ExportError)


def test_new_files_and_folders_have_the_mode_of_the_umask_which_stays_as_it_is(tmp_path, monkeypatch):
    changed: list[int] = []
    before = os.umask(0o027)
    try:
        with monkeypatch.context() as patched:
            # Another thread that makes a file meanwhile would see the change.
            patched.setattr(os, "umask", lambda mask: changed.append(mask) or 0o027)
            write_whole(tmp_path / "file", lambda place: place.write_text("words"))
            write_folder(tmp_path / "folder", {"inside": b""}, {})
    finally:
        os.umask(before)
    modes = [(tmp_path / name).stat().st_mode & 0o777 for name in ("file", "folder", "folder/inside")]
    assert modes == [0o640, 0o750, 0o640]
    assert changed == []


def test_what_a_link_leads_to_is_written_and_the_current_folder_refused(tmp_path, monkeypatch):
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    write_whole(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_text() == "new"
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    with pytest.raises(ExportError), new_folder(Path("."), raising=ExportError):
        pass
    # As where another program has deleted it.
    (tmp_path / "empty").rmdir()
    with pytest.raises(ExportError), new_folder(Path("x"), raising=ExportError):
        pass
    with pytest.raises(ExportError):
        write_whole(Path("x"), "new", raising=ExportError)


def test_a_folder_that_cannot_be_replaced_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").touch()
    rename, renamed = os.rename, list[Path]()

    def second_fails(source: Path, target: Path) -> None:
        renamed.append(source)
        if len(renamed) == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        rename(source, target)

    monkeypatch.setattr("avmsf._utils.files.os.rename", second_fails)
    with raises(ExportError), new_folder(tmp_path / "folder", raising=ExportError, replace=True) as begun:
        (begun / "new").touch()
    assert [path.name for path in tmp_path.rglob("*")] == ["folder", "mine"]


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"old")
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with raises(ExportError, file=tmp_path / "file") as caught:
            write_whole(tmp_path / "file", bytes(8192), raising=ExportError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert isinstance(caught.value.__cause__, OSError)
    assert caught.value.__cause__.errno == errno.EFBIG
    assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [("file", b"old")]


def test_a_kill_before_the_last_moment_leaves_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"old")
    script = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom avmsf._utils.files import write_whole\n"
        "os.replace = lambda *given: os.kill(os.getpid(), signal.SIGKILL)\nwrite_whole(Path(sys.argv[1]), b'new')"
    )
    killed = subprocess.run([sys.executable, "-c", script, str(tmp_path / "file")], timeout=60, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / "file").read_bytes() == b"old"
    # The half-done file lies hidden beside it, has no name of the user's, and is in no later saving's way.
    (left,) = [each for each in tmp_path.iterdir() if each.name != "file"]
    assert left.name.startswith(".file.")
    write_whole(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"


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
    def intrude() -> None:
        with write_lock(tmp_path, "stages", command="other", wait=0.1):
            pytest.fail("two threads hold the lock")

    with write_lock(tmp_path, "stages", command="me"), ThreadPoolExecutor(1) as other:
        with write_lock(tmp_path, "stages", command="again", wait=0.0):
            pass
        refused = other.submit(intrude).exception()
    assert isinstance(refused, FolderInUseError)
    assert refused.value["command"] == "me"


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
    tmp_path, monkeypatch, number, writable, held
):
    def refuse(path: str, *rest: int, **named: int) -> int:
        raise OSError(number, os.strerror(number), path)

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(os, "access", lambda *arguments: writable)
    with nullcontext() if held else pytest.raises(AvmsfError), write_lock(tmp_path, "stages", command="me"):
        assert held


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_disk_without_locks_gets_no_file_that_outlives_its_process(tmp_path, monkeypatch, number):
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with write_lock(tmp_path, "stages", command="me"):
        # A lock by a file's existence would stay after a kill, and let nobody else in.
        monkeypatch.undo()
        with hold(tmp_path) as other:
            other.communicate()
