"""What the page is told where something cannot be done: a sentence that says how it can, and a status."""

import errno
import json
import reprlib
from typing import Any

import torch
from starlette.responses import JSONResponse

from avmsf._utils.memory import lacks_memory
from avmsf.errors import AvmsfError, StudioError
from avmsf.files import way_out

UNUSABLE = 422
"""Status of what was understood and cannot be used, as a recording of silence."""


_FULL = (errno.ENOSPC, errno.EDQUOT)
NUMERIC_ERRORS = (ValueError, ArithmeticError, torch.linalg.LinAlgError)  # type: ignore[attr-defined]
"""What edits and searches raise for numbers that passed all checks and still lead to no result."""
FORESEEN_ERRORS = (OSError, MemoryError, RecursionError)
"""Errors that `refusal_of` has an answer for, whatever was asked."""
_MAX_ECHO = 100
"""Characters of a request that an answer repeats."""
_repr = reprlib.Repr()
_repr.maxstring = _repr.maxother = _MAX_ECHO - 2
_repr.maxlevel = 3


class RefusedError(StudioError):
    """A request that is not done, with its HTTP status and perhaps more than words."""

    def __init__(self, status: int, words: str, **more: Any) -> None:
        super().__init__(words)
        self.status, self.more = status, more


class Answer(JSONResponse):
    """JSON in ASCII, which also holds file names that are not valid Unicode."""

    def render(self, content: Any) -> bytes:
        """Return the body."""
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")


def response_to(error: AvmsfError) -> Answer:
    """Return what the page is answered: the error's words, and what more a `RefusedError` has to say."""
    status = error.status if isinstance(error, RefusedError) else UNUSABLE
    more = error.more if isinstance(error, RefusedError) else {}
    return Answer({"error": " ".join(str(error).split()), **more}, status)


def refusal_of(error: Exception) -> RefusedError:
    """Return the answer to a request that failed by one of `FORESEEN_ERRORS`, or where there is not enough memory.

    The page sends a recording again after a status of 500 or more, and not after a lower one.
    """
    if lacks_memory(error):
        return RefusedError(503, "there is not enough memory for this: close other programs, or send less")
    if isinstance(error, OSError):
        where = "" if error.filename is None else f"{error.filename}: "
        what = f"{where}cannot be read or written ({error.strerror or error}): {way_out(error)}"
        return RefusedError(507 if error.errno in _FULL else 503, what)
    if isinstance(error, RecursionError):
        return RefusedError(400, "expected a request of few levels, got one nested too deeply: reload the page")
    return RefusedError(
        UNUSABLE, f"the computation failed ({type(error).__name__}: {str(error)[:_MAX_ECHO]}): try other values"
    )


def echo(value: Any) -> str:
    """Return a value of a request as an answer may repeat it: at most 100 printable characters."""
    return _repr.repr(value)[:_MAX_ECHO]
