"""Files that cannot be written: advice that fits the system's error, and what was there before."""

import errno
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from avmsf._utils.files import new_folder, way_out, write_whole
from avmsf.errors import ExportError
from avmsf.export.writing import write_folder
from factories.raising import raises

NUMBERS = (errno.ENOSPC, errno.EACCES, errno.EROFS, errno.ENAMETOOLONG, errno.EIO)


def test_a_file_in_a_folders_place_and_a_folder_in_a_files_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name, number in (("file/new", errno.EEXIST), ("file/deep/new", errno.ENOTDIR), ("folder", errno.EISDIR)):
        with raises(ExportError, file=tmp_path / name, value=os.strerror(number)) as refused:
            write_whole(tmp_path / name, b"", raising=ExportError)
        assert str(refused.value).endswith(way_out(OSError(number, "")))
    # Each cause has its own advice, but these two.
    assert way_out(OSError(errno.EEXIST, "")) == way_out(OSError(errno.ENOTDIR, ""))
    numbers = (*NUMBERS, errno.EEXIST, errno.EISDIR)
    assert len({way_out(OSError(number, "")) for number in numbers}) == len(numbers)


def test_new_files_and_folders_have_the_mode_of_the_umask_which_stays_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
