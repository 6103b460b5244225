"""Files that only save time: where one cannot be written, the work goes on without it."""

import hashlib
import os
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

from avmsf.errors import AvmsfError, AvmsfWarning


def keep_if_possible(write: Callable[[], object], path: Path) -> None:
    """Call `write`, which writes `path`; where the system does not let it, warn once for each folder and go on.

    Raises what `write` raises for any other reason than an OSError.
    """
    try:
        write()
    except AvmsfError as error:
        if not isinstance(error.__cause__, OSError):
            raise
        _warn_once(path.parent, error.__cause__.strerror or str(error.__cause__))


def is_kept(path: Path) -> bool:
    """Return whether there is such a file; where its folder cannot be read, there is none."""
    return os.path.isfile(path)


def discard(path: Path) -> None:
    """Remove a file that is not needed any more; one that cannot be removed costs nothing but its space."""
    with suppress(OSError):
        path.unlink()


@cache
def source_digest() -> str:
    """Return a digest of this package's source files, for the keys of what its code has made.

    The version alone changes with a release only, so that results of code that has changed since would be taken for
    those of the present one. All files count, for what a result depends on is not known file by file.
    """
    return digest_of_sources(Path(__file__).parents[1])


def digest_of_sources(root: Path) -> str:
    """Return a digest of the names and contents of all Python files below a folder."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def _warn_once(folder: Path, reason: str) -> None:
    warnings.warn(
        f"{folder}: nothing can be kept there ({reason}), so the next run computes it again; the result is the same",
        AvmsfWarning,
        stacklevel=3,
    )
