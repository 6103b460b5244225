"""A fit's progress, on the standard error."""

import sys
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from avmsf._utils.wording import counted
from avmsf.cli.heartbeat import doing, verbosity
from avmsf.cli.printing import console, figure, say
from avmsf.field.fit import Progress as FitProgress


class FitBar:
    """One bar a stage, with its own loss and the time it has left; in a file or a pipe, a line each few seconds."""

    def __init__(self) -> None:
        self.live = sys.stderr.isatty()
        self.stage = ""
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[loss]}"),
            TimeRemainingColumn(),
            console=console(errors=True),
            disable=not self.live or verbosity.quiet,
        )
        self.task = self.bar.add_task("", total=None, loss="–", visible=False)

    def __enter__(self) -> "FitBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    def show(self, progress: FitProgress) -> None:
        """Take note of one step."""
        self.bar.start()
        if progress.step <= progress.warmup:
            stage, step, steps = f"{progress.stage}, warm-up", progress.step, progress.warmup
            loss = f"squared gain error {figure(progress.loss)}"
        else:
            stage, step = f"{progress.stage}, end to end", progress.step - progress.warmup
            steps = progress.steps - progress.warmup
            loss = f"spectral loss {figure(progress.loss)}"
        if stage != self.stage and self.live:
            self.bar.remove_task(self.task)
            self.task = self.bar.add_task(stage, total=steps, loss="–")
        self.stage = stage
        if self.live:
            self.bar.update(self.task, completed=step, loss=loss)
        elif step == steps:
            say(f"{stage}: {counted(steps, 'step')}, {loss}")
        else:
            doing(f"{stage}: step {step} of {steps}, {loss}")
