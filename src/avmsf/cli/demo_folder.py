"""The folder that `avmsf demo` fills: an earlier demo stays complete until the new one is."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from avmsf._utils.files import way_out
from avmsf._utils.locks import write_lock
from avmsf._utils.text_files import read_json
from avmsf._utils.wording import counted
from avmsf.cli.options.checks import OutputError

FORMAT = "avmsf demo 1"
"""Format of the folder in `demo.json`."""
RECORD = "demo.json"
"""File that names all files of a finished demo."""
UNFINISHED, REPLACED = ".avmsf-demo-unfinished", ".avmsf-demo-replaced"
"""Folders inside the demo's own that hold the new demo until it is complete, and the old one while it is replaced."""
_LOCK = ".avmsf-demo"
"""Name of the lock under which a demo is made."""
_LOCK_FILES = {f"{_LOCK}.lock", f"{_LOCK}.lock.json"}
_SHOWN = 3
"""Foreign files that an error names."""


@contextmanager
def replaced_whole(folder: Path) -> Iterator[Path]:
    """Give an empty folder to fill, inside `folder`; in the end its content takes the place of an earlier demo's.

    Whatever is raised meanwhile, Ctrl-C included, leaves `folder` as it was. Raises `OutputError` for a folder with
    files that no demo wrote, and where nothing can be written, and `FolderInUseError` while another demo fills it.
    """
    known = folder.exists()
    _expect_own(folder)
    try:
        with write_lock(folder, _LOCK, command="avmsf demo", advice=", or name another folder", parents=True):
            yield from _replacing(folder)
    finally:
        if not known:
            with suppress(OSError):
                folder.rmdir()


def _replacing(folder: Path) -> Iterator[Path]:
    """Yield the folder to fill, under the lock, and leave no file of the lock."""
    begun = folder / UNFINISHED
    try:
        shutil.rmtree(begun, ignore_errors=True)
        begun.mkdir(parents=True)
        yield begun
        _expect_own(folder)
        _replace(folder, begun)
    except OSError as error:
        path, reason = error.filename or folder, error.strerror or str(error)
        raise OutputError.expected("a writable path", reason, file=path, advice=way_out(error)) from error
    finally:
        shutil.rmtree(begun, ignore_errors=True)
        # Whoever waits for it looks again when a lock's file is gone.
        with suppress(OSError):
            (folder / f"{_LOCK}.lock").unlink()


def record(folder: Path) -> dict[str, object]:
    """Return what a finished demo's record says of it: its format and the files in `folder`, the record included."""
    files = {RECORD} | {each.relative_to(folder).as_posix() for each in folder.rglob("*") if not each.is_dir()}
    return {"format": FORMAT, "files": sorted(files)}


def _own_files(folder: Path) -> set[str]:
    """Return the files of the finished demo in a folder, none where there is no record of one."""
    try:
        known = read_json(folder / RECORD)
    except (OSError, ValueError):
        return set()
    if not isinstance(known, dict) or known.get("format") != FORMAT or not isinstance(known.get("files"), list):
        return set()
    return {str(each) for each in known["files"]}


def _expect_own(folder: Path) -> None:
    """Raise `OutputError` where a folder holds more than a demo."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise OutputError(f"{folder}: expected a folder, got a file; choose another name", file=folder, value="file")
    own = _own_files(folder)
    found = {each.relative_to(folder) for each in folder.rglob("*") if not each.is_dir() or each.is_symlink()}
    # An old demo that was being deleted when its successor was already complete.
    passed = {UNFINISHED, *_LOCK_FILES, *({REPLACED} if own else ())}
    foreign = sorted(each.as_posix() for each in found if each.as_posix() not in own and each.parts[0] not in passed)
    if foreign:
        shown = ", ".join(foreign[:_SHOWN]) + (", ..." if len(foreign) > _SHOWN else "")
        raise OutputError(
            f"{folder}: expected an empty folder or an earlier demo, got {counted(len(foreign), 'file')} that no demo "
            f"wrote ({shown}); choose another folder, or move them away",
            file=folder,
            value=foreign,
        )


def _replace(folder: Path, begun: Path) -> None:
    """Move the old demo aside and the new one in, the record first and last, or all back where that fails."""
    aside = folder / REPLACED
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    old = sorted({each.split("/")[0] for each in _own_files(folder) if (folder / each).exists()})
    new = sorted(each.name for each in begun.iterdir())
    out = [(folder / name, aside / name) for name in sorted(old, key=lambda name: name != RECORD)]
    moves = out + [(begun / name, folder / name) for name in sorted(new, key=lambda name: name == RECORD)]
    try:
        for source, target in moves:
            source.rename(target)
    except BaseException:
        for source, target in reversed(moves):
            if not source.exists() and target.exists():
                target.rename(source)
        aside.rmdir()
        raise
    shutil.rmtree(aside, ignore_errors=True)
