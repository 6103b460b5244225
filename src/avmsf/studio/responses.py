"""Error responses: a message that says what to do, and an HTTP status."""

import errno
import json
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from starlette.responses import JSONResponse

from avmsf.errors import AvmsfError, FolderInUseError, RecordingLengthError, StudioError, lacks_memory

UNUSABLE = 422
"""Status of what was understood and cannot be used, as a recording of silence."""
_STATUSES: Mapping[type[AvmsfError], int] = {FolderInUseError: 503, RecordingLengthError: 413}
"""Other statuses of errors that are no `RequestError`."""
NUMERIC_ERRORS = (ValueError, ArithmeticError, torch.linalg.LinAlgError)  # type: ignore[attr-defined]
"""Errors of edits and searches for valid numbers that give no result."""
FORESEEN_ERRORS = (OSError, MemoryError, RecursionError)
"""Errors that `error_response` has a response for."""
_MAX_ECHO = 100
"""Characters of a request that an answer repeats."""
_repr = reprlib.Repr()
_repr.maxstring = _repr.maxother = _MAX_ECHO - 2
_repr.maxlevel = 3


class RequestError(StudioError):
    """A request that is not done, with its HTTP status and `more` entries for the answer."""

    def __init__(self, status: int, message: str, *, more: Mapping[str, Any] | None = None, **attributes: Any) -> None:
        super().__init__(message, **attributes)
        self.status, self.more = status, more or {}


class Answer(JSONResponse):
    """JSON in ASCII, which also holds file names that are not valid Unicode."""

    def render(self, content: Any) -> bytes:
        """Return the body."""
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")


def response_to(error: AvmsfError) -> Answer:
    """Return the response: the error's message, and the `more` of a `RequestError`."""
    status, more = _STATUSES.get(type(error), UNUSABLE), dict[str, Any]()
    if isinstance(error, RequestError):
        status, more = error.status, dict(error.more)
    return Answer({"error": " ".join(str(error).split()), **more}, status)


def error_response(error: Exception) -> RequestError:
    """Return the answer to a request that failed by one of `FORESEEN_ERRORS`, or where there is not enough memory.

    The page sends a recording again after a status of 500 or more, and not after a lower one.
    """
    if lacks_memory(error):
        return bad_request("memory", "more", got="too little", advice="close other programs, or send less", status=503)
    if isinstance(error, OSError):
        where = "" if error.filename is None else f"{error.filename}: "
        reason = error.strerror or str(error)
        return RequestError(
            507 if error.errno in (errno.ENOSPC, errno.EDQUOT) else 503,
            f"{where}expected a file to read or write, got {reason!r}; choose another folder or name",
            file=error.filename if isinstance(error.filename, str | Path) else None,
            value=reason,
        )
    if isinstance(error, RecursionError):
        return RequestError(400, "expected a request of few levels, got too many; reload the page")
    reason = f"{type(error).__name__}: {str(error)[:_MAX_ECHO]}"
    return RequestError(UNUSABLE, f"expected values that give a result, got {reason}; try other values", value=reason)


def bad_request(
    name: str,
    wanted: str,
    value: Any = None,
    *,
    got: str | None = None,
    advice: str = "",
    status: int = 400,
    file: Path | str | None = None,
    **more: Any,
) -> RequestError:
    """Return the response to an invalid entry, or one of a file; `got` is shown in place of its value."""
    message = f"{file or name}: expected {wanted}, got {got or _repr.repr(value)[:_MAX_ECHO]}{advice and f'; {advice}'}"
    return RequestError(status, message, file=file, name=name, value=value, more=more)
