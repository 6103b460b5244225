"""One family of errors: whatever the user can cause and mend is an `AvmsfError` with a message that says how.

And one of warnings, `AvmsfWarning`: what goes on all the same, and the user should know.
"""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

_Kind = TypeVar("_Kind", bound="_Located")


class _Located(Exception):  # noqa: N818 - warnings have it too
    """Where the input at fault is, and what it is; None for what does not apply."""

    def __init__(
        self,
        message: str = "",
        *,
        file: Path | str | None = None,
        row: int | None = None,
        name: str | None = None,
        value: Any = None,
    ) -> None:
        super().__init__(message)
        self.file = None if file is None else Path(file)
        """The file or folder."""
        self.row = row
        """The line of a text file, from 1 with the header, or the index in an array, from 0."""
        self.name = name
        """The argument, option, column, key, method or object."""
        self.value = value
        """What was found in place of what was expected: a number, a text, a shape, a list of names."""

    @classmethod
    def expected(
        cls: type[_Kind],
        wanted: str,
        value: Any = None,
        *,
        got: str | None = None,
        file: Path | str | None = None,
        row: int | None = None,
        name: str | None = None,
        advice: str = "",
    ) -> _Kind:
        """Return one with the message `PLACE, row ROW: expected WANTED, got VALUE; ADVICE`.

        The place is the file, else the name, and one of them is needed. `got` says what was found where the value does
        not; without both it is none.
        """
        place = f"{name if file is None else file}{'' if row is None else f', row {row}'}"
        shown = f"{value:g}" if isinstance(value, float) else repr(value) if isinstance(value, str) else str(value)
        found = got or ("none" if value is None else shown)
        message = f"{place}: expected {wanted}, got {found}{advice and f'; {advice}'}"
        return cls(message, file=file, row=row, name=name, value=value)

    @classmethod
    def unknown(cls: type[_Kind], value: str, known: Collection[str], *, name: str, cutoff: float = 0.6) -> _Kind:
        """Return one for a value that is none of the known ones, with the one that is most similar (`difflib`)."""
        near = get_close_matches(value.lower(), known, n=1, cutoff=cutoff)
        advice = f"did you mean {near[0]}?" if near else ""
        return cls.expected(f"one of {', '.join(known)}", value, name=name, advice=advice)

    @property
    def attributes(self) -> dict[str, Any]:
        """The four attributes by name, for an error that passes this one on."""
        return {"file": self.file, "row": self.row, "name": self.name, "value": self.value}

    def about(self: _Kind, file: Path) -> _Kind:
        """Return the same about a file, with which the message then begins."""
        return type(self)(f"{file}: {self}", **{**self.attributes, "file": file})


class AvmsfError(_Located):
    """Something the user gave cannot be used; the message says what was expected, what was found and what to do.

    The attributes `file`, `row`, `name` and `value` say the same to programs.
    """


class AvmsfWarning(_Located, UserWarning):
    """Something is not as it should be, and the work continues; the message says what, and what to do.

    The attributes are those of AvmsfError.
    """


class FolderInUseError(AvmsfError):
    """Another process writes into this folder; `value` says which, a dict that is empty where that is not known."""


class WorkerError(AvmsfError):
    """A process that worked on a part ended without a result; `value` says by what."""


class ArrayError(AvmsfError):
    """An array given to a function has a shape or values that cannot be used: argument `name`, first index `row`."""


class PositionError(ArrayError):
    """A position is not on the object."""


class PositionWarning(AvmsfWarning):
    """A position is nearer to the object than this is large, and not on it."""


class CaptureWarning(AvmsfWarning):
    """A capture was read, but a recording or a contact in it is probably wrong; the message says what to do."""


class CaptureError(AvmsfError):
    """A capture folder, its table, its settings or one of its sound files cannot be used."""


class RecordingLengthError(CaptureError):
    """A sound file holds more samples than are read."""


class SceneError(AvmsfError):
    """Views, Gaussians, features or symmetries cannot be made or read."""


class ExtractionError(AvmsfError):
    """No modes can be drawn from these recordings."""


class FitError(AvmsfError):
    """A field cannot be fitted to these impacts, features and modes."""


class FieldFileError(AvmsfError):
    """A file is not a field that this version can read, or a field cannot be written."""


class LocationError(AvmsfError):
    """A recording that has no contact with this object."""


class EditError(AvmsfError):
    """A field cannot be edited as asked: the material, the reference, the prompt or the model does not allow it."""


class EvaluationError(AvmsfError):
    """Sounds or contacts given to a metric, a baseline or a split do not fit together."""


class DatasetError(AvmsfError):
    """A dataset's folder is another dataset's, is incomplete, or has no object of this name."""


class SimulationError(AvmsfError):
    """A shape, a material or a setting from which no sounding object can be computed."""


class ExportError(AvmsfError):
    """A field cannot be written in another tool's format, or another tool's file cannot be read."""


class StudioError(AvmsfError):
    """The page's server cannot start, or was asked for what it does not do."""


NO_MEMORY = "expected more free memory; close other programs, or use less data, fewer modes or smaller images"
"""The end of the message of such an error."""


def lacks_memory(error: BaseException) -> bool:
    """Return whether an error means that the system gave no memory.

    PyTorch's allocators raise RuntimeErrors. Shared libraries that cannot be mapped raise ImportError, or
    OSError where ctypes opens them.
    """
    if isinstance(error, RuntimeError):
        return any(words in str(error) for words in ("DefaultCPUAllocator", "CUDA out of memory"))
    if isinstance(error, OSError | ImportError):
        if any(words in str(error) for words in ("failed to map segment", "annot allocate memory")):
            return True
        # llvmlite raises another OSError, which names no reason, while it handles this one.
        return error.__context__ is not None and lacks_memory(error.__context__)
    return isinstance(error, MemoryError)


@contextmanager
def from_extra(extra: str, package: str, *, raising: type[AvmsfError], instead: str = "") -> Iterator[None]:
    """Import an optional package within; where that fails, raise `raising` with its name and how to install its extra.

    `instead` says how to do without it.
    """
    try:
        yield
    except (ImportError, RuntimeError) as error:  # RuntimeError: one of the package's own packages is broken
        advice = f"pip install 'avmsf[{extra}]'" + (f", or {instead}" if instead else "")
        raise raising.expected("an installed package", got=str(error), name=package, advice=advice) from error


def download_failure(error: BaseException) -> str:
    """Return in plain words why a model could not be downloaded, from an error of the hub's client or its cause."""
    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answered with code {response.status_code}"
    if error.__cause__ is not None:
        return download_failure(error.__cause__)
    if "Connect" in type(error).__name__ or isinstance(error, ConnectionError | TimeoutError):
        return "the server cannot be reached"
    return next(iter(str(error).strip().splitlines()), type(error).__name__)[:200].rstrip(".")
