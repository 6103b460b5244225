"""Loops compiled for the processor, kept from one run to the next where that is possible."""

from collections.abc import Callable
from typing import Any

import numba


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call, by numba's `options`.

    What was compiled is kept beside the package, or in the user's cache, so that later runs load it. Where neither
    folder may be written to, as in a container without a home, every run compiles anew: `NUMBA_CACHE_DIR` names
    another.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            made: Callable[..., Any] = numba.njit(cache=True, **options)(function)
        except RuntimeError:
            # Numba looks for a folder at once, and raises this where it finds none.
            made = numba.njit(**options)(function)
        return made

    return decorate
