"""Files that only save time: where one cannot be written, the work goes on without it."""

import hashlib
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from avmsf.errors import AvmsfError, AvmsfWarning

Given = ParamSpec("Given")
Result = TypeVar("Result")


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
    """Return a digest of the names and contents of all Python files beneath a folder."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def once(make: Callable[Given, Result]) -> Callable[Given, Result]:
    """Return `make`, which is called once for the same arguments: later calls return its result, or raise its error.

    Only an AvmsfError counts as an answer.
    """

    @cache
    def answer(*given: Given.args, **named: Given.kwargs) -> Result | AvmsfError:
        try:
            return make(*given, **named)
        except AvmsfError as error:
            return error

    @wraps(make)
    def kept(*given: Given.args, **named: Given.kwargs) -> Result:
        found = answer(*given, **named)  # type: ignore[arg-type]  # No ParamSpec can say that they are hashable.
        if isinstance(found, AvmsfError):
            raise found
        return found

    return kept


@cache
def _warn_once(folder: Path, reason: str) -> None:
    warnings.warn(
        AvmsfWarning(
            f"{folder}: expected a folder for cached results, got {reason!r}; the next run computes them again",
            file=folder,
            value=reason,
        ),
        stacklevel=3,
    )
