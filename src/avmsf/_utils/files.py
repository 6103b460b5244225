"""Files that are either as they were or as they shall be, never in between."""

import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from avmsf.errors import AvmsfError, FieldFileError

_LFS = b"version https://git-lfs.github.com/spec/"


def unwritable(path: Path, error: Exception, *, raising: type[AvmsfError], unchanged: str = "") -> AvmsfError:
    """Return the error of a file or folder that could not be written, for the reason that the system gives."""
    reason = getattr(error, "strerror", None) or str(error)
    return raising.expected("a writable path", reason, file=path, advice=f"{unchanged}choose another folder or name")


def is_lfs_pointer(path: Path) -> bool:
    """Return whether a file is what Git LFS leaves where its content was not fetched; False where none can be read."""
    try:
        with open(path, "rb") as file:
            return file.read(len(_LFS)) == _LFS
    except OSError:
        return False


def model_folder(source: str | Path, what: str, *, raising: type[AvmsfError]) -> Path | None:
    """Return the folder of a model, or None for its name on the hub: an owner and a model, where paths differ.

    Raises `raising` where it is neither; `what` it should be.
    """
    folder, words = Path(source).expanduser(), str(source).split("/")
    if folder.is_dir():
        return folder
    if isinstance(source, str) and len(words) == 2 and all(words) and words[0][0] not in ".~":
        return None
    raise raising.expected(what, str(source), got="no such folder", file=folder, name="source", advice="check the path")


def temporary_path(path: Path) -> Path:
    """Return a name, free in all likelihood, of a hidden file or folder in the same folder as `path`."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")


def write_whole(
    path: Path, content: bytes | str | Callable[[Path], object], *, raising: type[AvmsfError] = FieldFileError
) -> None:
    """Write a temporary file beside `path`, then move it there in one step; missing folders are made.

    `content` is the file's, or a function that fills the file at a path; text becomes UTF-8. What was there stays whole
    until then: a full disk or a kill leaves the old file, a kill perhaps a hidden `.NAME.….part` beside it, which
    nothing reads. Raises `raising`.
    """
    temporary, named = None, path
    try:
        # What a link leads to is replaced, and the link stays.
        path = Path(os.path.realpath(path))
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_path(path)
        # Unlike tempfile.mkstemp, this lets the system apply the umask, as for any file that is to be shared.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        if callable(content):
            content(temporary)
        else:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise unwritable(named, error, raising=raising, unchanged="an old file is unchanged; ") from error
    finally:
        if temporary is not None:
            # What could not be made cannot be looked for either, where its name is too long.
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def copy_whole(source: Path, path: Path, *, raising: type[AvmsfError] = FieldFileError) -> None:
    """Copy a file as `write_whole` writes one. Raises `raising`."""
    write_whole(path, lambda place: shutil.copyfile(source, place), raising=raising)


@contextmanager
def new_folder(folder: Path, *, raising: type[AvmsfError], replace: bool = False) -> Iterator[Path]:
    """Yield a temporary folder, which in the end takes the name `folder`: that is complete, or as it was.

    With `replace` all that was in the folder is deleted then. Raises `raising` where the folder cannot be written or is
    a file, and without `replace` where it is not empty.
    """
    # The shell that runs this would stay in the folder that was there before.
    here = folder.is_dir() and folder.samefile(os.curdir)
    if here or (folder.exists() and (not folder.is_dir() or (not replace and any(folder.iterdir())))):
        got, advice = "the current one" if here else "an existing one", "choose another name or remove it"
        raise raising.expected("a new or empty folder", got=got, file=folder, advice=advice)
    begun, named = None, folder
    try:
        # What a link leads to is replaced, and the link stays.
        folder = Path(os.path.realpath(folder))
        begun, old = temporary_path(folder), temporary_path(folder)
        begun.mkdir(parents=True)
        yield begun
        if replace and folder.exists():
            os.rename(folder, old)
        elif folder.exists():
            folder.rmdir()
        try:
            os.rename(begun, folder)
        except OSError:
            if old.exists():
                os.rename(old, folder)
            raise
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise unwritable(named, error, raising=raising) from error
    finally:
        if begun is not None:
            shutil.rmtree(begun, ignore_errors=True)
