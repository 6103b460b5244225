"""Files that only save time: where one cannot be written, the work goes on without it."""

import hashlib
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from avmsf.errors import AvmsfError, AvmsfWarning

Given = ParamSpec("Given")
Result = TypeVar("Result")
_IMPORT = r"^\s*from ({0}(?:\.\w+)*) import (\([^)]*\)|.*)"


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
def source_digest(module: str, root: Path = Path(__file__).parents[2]) -> str:
    """Return a digest of a module's source and of all modules of its package that it imports, directly or not.

    It belongs to the keys of cached results: the version changes with a release only. Imports within functions count
    too. `root` is the folder that holds the package.
    """
    found: dict[Path, bytes] = {}
    pending = [module]
    while pending:
        path = _source_of(pending.pop(), root)
        if path not in found and path.exists():
            found[path] = path.read_bytes()
            pending += _imported(found[path].decode(), module.partition(".")[0], root)
    digest = hashlib.sha256()
    for path in sorted(found):
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + found[path])
    return digest.hexdigest()


def _source_of(module: str, root: Path) -> Path:
    """Return the file of a module or package."""
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(source: str, package: str, root: Path) -> Iterator[str]:
    """Yield the modules of a package that a source imports, also where a package's stub passes names on."""
    for module, names in re.findall(_IMPORT.format(package), source, re.MULTILINE):
        yield module
        if not root.joinpath(*module.split(".")).is_dir():
            continue
        stub = root.joinpath(*module.split("."), "__init__.pyi")
        passed = stub.read_text() if stub.exists() else ""
        for name in re.findall(r"\w+", names):
            if _source_of(f"{module}.{name}", root).exists():
                yield f"{module}.{name}"
            for inner in re.findall(rf"^from \.([\w.]+) import {name}\b", passed, re.MULTILINE):
                yield f"{module}.{inner}"


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
    wanted, advice = "a folder for cached results", "the next run computes them again"
    warnings.warn(AvmsfWarning.expected(wanted, reason, file=folder, advice=advice), stacklevel=3)


def content_digest(*parts: Any) -> str:
    """Return a digest of plain values, and of arrays and tensors with their types and shapes."""
    digest = hashlib.sha256()
    for part in parts:
        array = part.detach().cpu().resolve_conj().resolve_neg().numpy() if hasattr(part, "detach") else part
        plain = not hasattr(array, "tobytes")
        digest.update(f"{array!r}\0".encode() if plain else f"{array.dtype} {array.shape}\0".encode() + array.tobytes())
    return digest.hexdigest()
