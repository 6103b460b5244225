"""No verb is silent for long: what it is doing is repeated on the standard error, with the time it has taken so far."""

import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from avmsf._utils.progress import calling
from avmsf._utils.text import printable

SILENCE_SECONDS = 4.0
"""After which a line is repeated: with the delays of a busy machine no silence is longer than five."""
_TICK_SECONDS = 0.25


class _Verbosity:
    """How much is printed besides results, warnings and errors, for the whole process: by --quiet and --verbose."""

    quiet = False
    verbose = False


verbosity = _Verbosity()


class _Activity:
    """The last line, and when it was printed and repeated."""

    def __init__(self) -> None:
        self.now("")

    def now(self, text: str) -> None:
        self.text, self.since = text, time.monotonic()
        self.printed = self.since

    def repeat(self) -> None:
        """Print the line again if nothing has been printed for long, unless a progress bar moves on the terminal."""
        moment, rich = time.monotonic(), sys.modules.get("rich.file_proxy")
        if (
            verbosity.quiet
            or moment - self.printed < SILENCE_SECONDS
            or (rich and isinstance(sys.stderr, rich.FileProxy))
        ):
            return
        self.printed = moment
        # On a terminal the line may begin behind "loading ...".
        start = "\r" if sys.stderr.isatty() else ""
        print(f"{start}{printable(self.text)} ... {moment - self.since:.0f} s", file=sys.stderr, flush=True)


_activity = _Activity()


def printed(text: str) -> None:
    """Take note of a line that was printed and says what begins."""
    _activity.now(text)


def doing(text: str) -> None:
    """Take note of what is going on, to be printed after a silence; costs next to nothing."""
    if _without_numbers(text) != _without_numbers(_activity.text):
        _activity.since = time.monotonic()
        if verbosity.verbose:
            print(printable(text), file=sys.stderr, flush=True)
    _activity.text = text


def _without_numbers(text: str) -> str:
    return re.sub(r"[-+.e\d]+", "", text)


@contextmanager
def beating(text: str) -> Iterator[None]:
    """Print something every few seconds while the block runs; `text` until `printed` or `doing` say what goes on."""
    _activity.now(text)
    with calling(_activity.repeat, every=_TICK_SECONDS):
        yield
