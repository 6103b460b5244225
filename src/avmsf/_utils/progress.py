"""Progress of work that takes long, on the standard error."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

REPEAT_SECONDS = 5.0
"""Interval of the lines that a file or a pipe gets."""


@contextmanager
def working(what: str, *, shown: bool) -> Iterator[None]:
    """Show what is done until it ends: moving on a terminal, as a line every few seconds in a file or a pipe."""
    if not shown:
        yield
        return
    from rich.console import Console  # only here: verbs that show nothing are to begin at once

    console = Console(stderr=True)
    with console.status(what) if is_live(console) else repeated(lambda: what):
        yield


def is_live(console: "Console") -> bool:
    """Return whether a console can show what moves: a terminal or a notebook."""
    return (console.is_terminal and not console.is_dumb_terminal) or console.is_jupyter


@contextmanager
def repeated(describe: Callable[[], str]) -> Iterator[None]:
    """Print what is done, and the seconds since its beginning, every few seconds while the block runs."""
    begun = time.monotonic()

    def line() -> None:
        print(f"{describe()} ... {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)

    with calling(line, every=REPEAT_SECONDS):
        yield


@contextmanager
def calling(function: Callable[[], None], *, every: float) -> Iterator[None]:
    """Call a function that prints every so many seconds while the block runs, in another thread."""
    ended = threading.Event()

    def repeat() -> None:
        # A standard error that was closed costs the lines alone.
        with suppress(OSError, ValueError):
            while not ended.wait(every):
                function()

    thread = threading.Thread(target=repeat, name="avmsf-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
