"""How far splatting and lifting are, on the standard error."""

import sys
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from avmsf.cli.heartbeat import doing, verbosity
from avmsf.cli.printing import SafeColumn, console, figure, say
from avmsf.features.lift import LiftProgress
from avmsf.gaussians.fit import SplatProgress
from avmsf.pipeline.scene import ProgressListener

_PARTS = 10
"""Lines that a file or a pipe gets for the whole of a stage."""


class SceneBar:
    """One bar a stage; in a file or a pipe, a line for each tenth of the splatting."""

    def __init__(self) -> None:
        self.live = sys.stderr.isatty()
        self.bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            SafeColumn("{task.fields[words]}"),
            TimeRemainingColumn(),
            console=console(errors=True),
            disable=not self.live or verbosity.quiet,
        )
        self.tasks: dict[str, TaskID] = {}
        self.told = 0

    def __enter__(self) -> "SceneBar":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    @property
    def listener(self) -> ProgressListener:
        """Who hears of the stages."""
        return ProgressListener(say, self.splatting, self.lifting, counting=say)

    def stop(self) -> None:
        """Leave the screen to another bar."""
        self.bar.stop()

    def splatting(self, progress: SplatProgress) -> None:
        """Take note of some steps."""
        words = f"loss {figure(progress.loss)}, {progress.psnr:.1f} dB, {progress.gaussians} Gaussians"
        self._show("splat", progress.step, progress.steps, words)
        part = progress.step * _PARTS // progress.steps
        line = f"splat: step {progress.step} of {progress.steps}, {words}, {progress.seconds:.0f} s"
        if not self.live and part > self.told:
            say(line)
        else:
            doing(line)
        self.told = part

    def lifting(self, progress: LiftProgress) -> None:
        """Take note of a view."""
        doing(f"features: {progress.view}, {progress.done} of {progress.total}")
        self._show("features", progress.done, progress.total, progress.view)

    def _show(self, stage: str, done: int, total: int, words: str) -> None:
        self.bar.start()
        if stage not in self.tasks:
            self.tasks[stage] = self.bar.add_task(stage, total=total, words="")
        self.bar.update(self.tasks[stage], completed=done, words=words)
