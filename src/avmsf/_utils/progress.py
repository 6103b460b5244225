"""Progress of work that takes long, on the standard error."""

import sys
import threading
import time
from collections.abc import Iterator
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
    with console.status(what) if is_live(console) else _repeated(what):
        yield


def is_live(console: "Console") -> bool:
    """Return whether a console can show what moves: a terminal or a notebook."""
    return (console.is_terminal and not console.is_dumb_terminal) or console.is_jupyter


@contextmanager
def _repeated(what: str) -> Iterator[None]:
    """Print what is done, and the seconds since its beginning, every few seconds while the block runs."""
    ended, begun = threading.Event(), time.monotonic()

    def repeat() -> None:
        # A standard error that was closed costs the lines alone.
        with suppress(OSError, ValueError):
            while not ended.wait(REPEAT_SECONDS):
                print(f"{what} ... {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)

    thread = threading.Thread(target=repeat, name="avmsf-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
