"""The progress of a verb, on the standard error."""

import sys
import time
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TimeRemainingColumn

from avmsf._utils.text import counted
from avmsf.cli.heartbeat import doing, verbosity
from avmsf.cli.printing import SafeColumn, console, say
from avmsf.pipeline.scene import ProgressListener


class ProgressBar:
    """A bar for each stage, with its last message and the time left; in a file or a pipe, a line at a stage's end."""

    def __init__(self) -> None:
        self.live = sys.stderr.isatty()
        self.begun = time.monotonic()
        self.bar = Progress(
            SafeColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            SafeColumn("{task.fields[message]}"),
            TimeRemainingColumn(),
            console=console(errors=True),
            disable=not self.live or verbosity.quiet,
        )
        self.tasks: dict[str, TaskID] = {}
        self.done = 0

    def __enter__(self) -> "ProgressBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    @property
    def listener(self) -> ProgressListener:
        """What the stages of a fit report to."""
        return ProgressListener(say, self.step, say)

    def step(self, stage: str, done: int, total: int, message: str) -> None:
        """Show how many steps of a stage are done, and a message on the last one."""
        self._update(stage, done, total, message)
        if done == total and not self.live:
            say(f"{stage}: {counted(total, 'step')}, {message}")
        else:
            doing(f"{stage}: step {done} of {total}, {message}")

    def objects(self, message: str, done: int, total: int) -> None:
        """Show how many objects are done, and what begins or ends; in a file or a pipe, a line for each object."""
        self._update("objects", done, total, message)
        if done > self.done and not self.live:
            say(f"{message} ({done} of {total}, {time.monotonic() - self.begun:.0f} s)")
        else:
            doing(f"{message} ({done} of {total})")
        self.done = done

    def _update(self, stage: str, done: int, total: int, message: str) -> None:
        self.bar.start()
        if stage not in self.tasks:
            self.tasks[stage] = self.bar.add_task(stage, total=total, message="")
        self.bar.update(self.tasks[stage], completed=done, message=message)
