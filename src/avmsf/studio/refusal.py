"""What the page is told where something cannot be done: a sentence that says how it can, and a status."""

from typing import Any

from starlette.responses import JSONResponse

from avmsf.errors import AvmsfError, StudioError

UNUSABLE = 422
"""Status of what was understood and cannot be used, as a recording of silence."""


class RefusedError(StudioError):
    """A request that is not done, with its HTTP status and perhaps more than words."""

    def __init__(self, status: int, words: str, **more: Any) -> None:
        super().__init__(words)
        self.status, self.more = status, more


def response_to(error: AvmsfError) -> JSONResponse:
    """Return what the page is answered: the error's words, and what more a `RefusedError` has to say."""
    status = error.status if isinstance(error, RefusedError) else UNUSABLE
    more = error.more if isinstance(error, RefusedError) else {}
    return JSONResponse({"error": " ".join(str(error).split()), **more}, status)
