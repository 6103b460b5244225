"""How far work on many objects is, on the standard error."""

import sys
import time
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from avmsf.cli.heartbeat import doing, verbosity
from avmsf.cli.printing import SafeColumn, console, say


class ObjectBar:
    """One bar over all objects, with what is being done to the one at hand; in a file or a pipe, a line an object."""

    def __init__(self) -> None:
        self.live = sys.stderr.isatty()
        self.begun = time.monotonic()
        self.bar = Progress(
            SafeColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console(errors=True),
            disable=not self.live or verbosity.quiet,
        )
        self.task = self.bar.add_task("", total=None)
        self.done = 0

    def __enter__(self) -> "ObjectBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    def show(self, words: str, *, done: int, total: int) -> None:
        """Take note of what has begun or ended, and of how many objects are through."""
        self.bar.start()
        self.bar.update(self.task, description=words, completed=done, total=total)
        if not self.live and done > self.done:
            say(f"{words} ({done} of {total}, {time.monotonic() - self.begun:.0f} s)")
        else:
            doing(f"{words} ({done} of {total})")
        self.done = done
