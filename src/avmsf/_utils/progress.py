"""Progress of work that takes long, on the standard error."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console

REPEAT_SECONDS = 5.0
"""Interval of the lines that a file or a pipe gets."""


@contextmanager
def working(what: str, *, shown: bool) -> Iterator[None]:
    """Show what is done until it ends: moving on a terminal, as a line every few seconds in a file or a pipe."""
    if not shown:
        yield
        return
    console = Console(stderr=True)
    with console.status(what) if is_live(console) else repeated(lambda: what):
        yield


def is_live(console: Console) -> bool:
    """Return whether a console can show what moves: a terminal or a notebook."""
    return (console.is_terminal and not console.is_dumb_terminal) or console.is_jupyter


@contextmanager
def repeated(describe: Callable[[], str]) -> Iterator[None]:
    """Print what is done, and the seconds since its beginning, every few seconds while the block runs."""
    begun, ended = time.monotonic(), threading.Event()

    def repeat() -> None:
        # A standard error that was closed costs the lines alone.
        with suppress(OSError, ValueError):
            while not ended.wait(REPEAT_SECONDS):
                print(f"{describe()} ... {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)

    thread = threading.Thread(target=repeat, name="avmsf-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
