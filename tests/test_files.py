"""Files that cannot be written: the words that fit what the system says."""

import errno
import os
from pathlib import Path

import pytest

from avmsf.errors import ExportError
from avmsf.export.written import write_folder
from avmsf.files import write_whole

SAID = {
    errno.ENOSPC: "free some space or choose another place",
    errno.EACCES: "make the folder one that you may write to, or choose another place",
    errno.EROFS: "choose another place, on a disk that can be written to",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOENT: "no file can be made there, choose another place",
    errno.EIO: "choose another place",
}


@pytest.mark.parametrize("number", SAID)
def test_what_helps_fits_what_the_system_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refuse(*arguments: object, **settings: object) -> None:
        raise OSError(number, os.strerror(number))

    for name in ("open", "mkdir"):
        monkeypatch.setattr(os, name, refuse)
    with pytest.raises(ExportError) as refused:
        write_whole(tmp_path / "file", lambda place: None, raising=ExportError)
    words = f"cannot be written ({os.strerror(number)})"
    assert str(refused.value) == f"{tmp_path / 'file'}: {words}; what was there is untouched: {SAID[number]}"
    with pytest.raises(ExportError) as refused:
        write_folder(tmp_path / "folder", lambda place: None, {})
    assert str(refused.value) == f"{tmp_path / 'folder'}: {words}: {SAID[number]}"


def test_a_file_in_a_folders_place_and_a_folder_in_a_files_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name in ("file/new", "file/deep/new"):
        with pytest.raises(ExportError, match="a file is where a folder has to be, choose another place"):
            write_whole(tmp_path / name, lambda place: None, raising=ExportError)
    with pytest.raises(ExportError, match="a folder of this name is there, name a file in it or choose another"):
        write_whole(tmp_path / "folder", lambda place: None, raising=ExportError)


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
            write_folder(tmp_path / "folder", lambda place: (place / "inside").touch(), {})
    finally:
        os.umask(before)
    modes = [(tmp_path / name).stat().st_mode & 0o777 for name in ("file", "folder", "folder/inside")]
    assert modes == [0o640, 0o750, 0o640]
    assert changed == []
