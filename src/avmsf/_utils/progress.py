"""The progress of work that takes long: what it reports, and how that is shown on the standard error."""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from avmsf._utils.text import printable

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

LINE_SECONDS = 60.0
"""After so long without a line one says what is being done."""


def _ignore(*values: object) -> None:
    pass


@dataclass(frozen=True)
class ProgressListener:
    """Callbacks that receive the progress of the stages."""

    log: Callable[[str], None] = _ignore
    """Receives a sentence as each part of a stage begins."""
    step: Callable[[str, int, int, str], None] = _ignore
    """Receives a stage's name, its steps done and in all, and a message on the last one."""
    ready: Callable[[str, float | None], None] = _ignore
    """Receives the name of a stage whose output is there, and the seconds that it took; None where it was cached."""
    note: Callable[[str], None] = _ignore
    """Receives a sentence that a user should know: what is missing, and what is done without it."""


class ProgressDisplay:
    """Progress on the standard error: a line that moves on a terminal, and everywhere a line when a stage is ready.

    A notebook counts as a terminal. Where no line moves, one says when a stage begins, and what is done whenever
    something is reported after a minute without a line.
    """

    def __init__(self, *, shown: bool = True, verbose: bool = False) -> None:
        """Show only notes unless `shown`, and with `verbose` print each part of a stage as it begins."""
        self.shown, self.verbose = shown, verbose
        self._bar: Progress | None = None
        self._shown: tuple[str, TaskID] | None = None
        self._begun: str | None = None
        self._printed = time.monotonic()

    def __enter__(self) -> "ProgressDisplay":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def listener(self) -> ProgressListener:
        """What the stages report to."""
        return ProgressListener(self._part, self.step, self.ready, self.note)

    def say(self, text: str, *, always: bool = False) -> None:
        """Print a line on what is done, if they are shown; with `always`, which errors are, even then."""
        self.close()
        self._printed = time.monotonic()
        if always or self.shown:
            print(printable(text), file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """Print what a user should know, in any case."""
        self.say(f"note: {text}", always=True)

    def doing(self, text: str) -> None:
        """Show what begins."""
        if self.verbose or self._silent:
            self.say(text)
        self._show(text, text, 0, None)

    def _part(self, text: str) -> None:
        """Show what part of a stage begins, in a line only a stage's first, "stage: what is done"."""
        stage, colon, _ = text.partition(":")
        begins = bool(colon) and stage.isalpha()
        if begins and stage != self._begun and not (self.verbose or self._moves):
            self.say(f"{text} ...")
        self._begun = stage if begins else self._begun
        self.doing(text)

    def step(self, stage: str, done: int, total: int, message: str) -> None:
        """Show how many steps of a stage are done, and a message on the last one."""
        text = f"{stage}: {message}" if message else stage
        if self._silent:
            self.say(f"{text} ({done} of {total})")
        self._show(stage, text, done, total)

    def ready(self, name: str, seconds: float | None) -> None:
        """Print that a stage is ready, with its time on the right."""
        self.say(f"{name:24}{'cached' if seconds is None else f'{seconds:.1f} s':>12}")

    def objects(self, after_each: Callable[[], object] = _ignore) -> Callable[[str, int, int], None]:
        """Return what receives which of several objects begins or ends, how many are done, and how many there are.

        When one is done it calls `after_each` and prints a line, and another after a minute without one.
        """
        finished, begun = 0, time.monotonic()

        def show(message: str, done: int, total: int) -> None:
            nonlocal finished
            if done > finished:
                after_each()
            if done > finished or self._idle:
                self.say(f"{message} ({done} of {total}, {time.monotonic() - begun:.0f} s)")
            finished = done
            self._show("objects", message, done, total)

        return show

    def close(self) -> None:
        """Remove the line that moves, until something is shown again."""
        if self._bar is not None:
            self._bar.stop()

    @property
    def _moves(self) -> bool:
        """Whether the standard error shows a line that moves."""
        plain = os.environ.get("TERM", "").lower() in ("dumb", "unknown")
        return (sys.stderr.isatty() and not plain) or "ipykernel" in sys.modules

    @property
    def _idle(self) -> bool:
        """Whether no line was printed for long."""
        return time.monotonic() - self._printed >= LINE_SECONDS

    @property
    def _silent(self) -> bool:
        """Whether no line was printed for long and none moves."""
        return self._idle and not self._moves

    def _show(self, stage: str, text: str, done: int, total: int | None) -> None:
        if not self.shown or not self._moves:
            return
        if self._bar is None:
            self._bar = _new_bar()
        self._bar.start()
        if self._shown is None or self._shown[0] != stage:
            if self._shown is not None:
                self._bar.remove_task(self._shown[1])
            self._shown = stage, self._bar.add_task("", total=total)
        self._bar.update(self._shown[1], description=printable(text).replace("[", "\\["), completed=done)


def _new_bar() -> "Progress":
    # Only here: what is shown in a file or a pipe does without rich.
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(file=sys.stderr)
    live = console.is_jupyter or (console.is_terminal and not console.is_dumb_terminal)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # What goes to a file or a pipe is not for the terminal.
    redirect = sys.stdout.isatty()
    return Progress(*columns, console=console, transient=True, disable=not live, redirect_stdout=redirect)
