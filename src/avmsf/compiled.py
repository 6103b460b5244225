"""Loops compiled for the processor, kept from one run to the next where that is possible."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call, by numba's `options`.

    What was compiled is kept beside the package, or in the user's cache, so that later runs load it. Where neither
    folder may be written to, as in a container without a home, or its disk is full, every run compiles again:
    `NUMBA_CACHE_DIR` names another.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            made: Any = numba.njit(cache=True, **options)(function)
        except RuntimeError:
            # Numba looks for a folder at once, and raises this where it finds none.
            return numba.njit(**options)(function)
        # Numba lets errors of the disk through to who calls the function.
        for step in ("load_overload", "save_overload"):
            setattr(made._cache, step, _without_disk_errors(getattr(made._cache, step)))
        return made

    return decorate


def _without_disk_errors(step: Callable[..., Any]) -> Callable[..., Any]:
    """Return a step of numba's cache that finds nothing, or keeps nothing, where the system does not let it."""

    def attempt(*arguments: Any) -> Any:
        try:
            return step(*arguments)
        except OSError:
            return None

    return attempt
