"""Progress of work that takes long, on the standard error."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console


@contextmanager
def working(what: str, *, shown: bool) -> Iterator[None]:
    """Show on a terminal what is done until it ends."""
    if not shown:
        yield
        return
    with Console(stderr=True).status(what):
        yield
