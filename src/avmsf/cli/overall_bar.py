"""How far a run of several stages is, and the time that it still takes, on the standard error."""

import sys
import time
from collections.abc import Mapping
from types import TracebackType

from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

from avmsf._utils.wording import counted
from avmsf.cli.heartbeat import doing, verbosity
from avmsf.cli.printing import SafeColumn, console, say
from avmsf.features.lift import LiftProgress
from avmsf.field.fit import Progress as FitProgress
from avmsf.gaussians.fit import SplatProgress
from avmsf.pipeline.scene import ProgressListener

REFINEMENT = "refinement"
"""Name of the stage that the steps of a fit are."""
_PRIOR = 0.15
"""Part of the run by which its pace here counts as much as the usual one in the estimate of the time left."""


class OverallBar:
    """One bar for the whole run, with its stage; in a file or a pipe, a line for each thing that begins."""

    def __init__(self, stages: Mapping[str, float]) -> None:
        """Take the stages in order, with the seconds that each usually takes."""
        self.stages, self.usual = stages, sum(stages.values())
        self.begun = time.monotonic()
        self.done = 0.0
        self._estimate = (self.begun, self.usual)
        self._stage = next(iter(stages))
        self._live = sys.stderr.isatty()
        self._bar = Progress(
            SafeColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:.0f} %"),
            _TimeLeft(self),
            console=console(errors=True),
            disable=not self._live or verbosity.quiet,
            transient=True,
        )
        self._task = self._bar.add_task(self._stage, total=1.0)

    def __enter__(self) -> "OverallBar":
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    @property
    def listener(self) -> ProgressListener:
        """Who hears of the stages that lead to features."""
        return ProgressListener(self.log, self._splatting, self._lifting)

    @property
    def left(self) -> float:
        """The time that the run probably still takes, seconds."""
        at, seconds = self._estimate
        return max(0.0, seconds - (time.monotonic() - at))

    def log(self, words: str) -> None:
        """Take note of what begins: of a stage, where the words are `stage: ...`, else of a part of the same stage."""
        stage = words.partition(":")[0]
        if stage in self.stages:
            self._stage = stage
        self._advance(0.0)
        if self._live:
            self._bar.update(self._task, description=words[:60])
        else:
            say(f"[{100 * self.done:3.0f} %, about {self.left:.0f} s left] {words}")

    def fitting(self, progress: FitProgress) -> None:
        """Take note of a step of the refinement, which follows the solution for the gains."""
        if self._stage != REFINEMENT and REFINEMENT in self.stages:
            self.log(f"{REFINEMENT}: {counted(progress.steps, 'step')}")
        doing(f"fit: step {progress.step} of {progress.steps}")
        self._advance(progress.step / progress.steps)

    def _splatting(self, progress: SplatProgress) -> None:
        doing(f"splat: step {progress.step} of {progress.steps}")
        self._advance(progress.step / progress.steps)

    def _lifting(self, progress: LiftProgress) -> None:
        doing(f"features: {progress.done} of {progress.total} views")
        self._advance(progress.done / progress.total)

    def _advance(self, part: float) -> None:
        """Take note that such a part of the stage is done, and of all stages before it."""
        names, seconds = list(self.stages), list(self.stages.values())
        place = names.index(self._stage)
        self.done = max(self.done, (sum(seconds[:place]) + part * seconds[place]) / self.usual)
        now = time.monotonic()
        whole = (now - self.begun + _PRIOR * self.usual) / (self.done + _PRIOR)
        self._estimate = (now, (1.0 - self.done) * whole)
        self._bar.update(self._task, completed=self.done)


class _TimeLeft(ProgressColumn):
    def __init__(self, bar: OverallBar) -> None:
        super().__init__()
        self._overall = bar

    def render(self, task: Task) -> Text:
        return Text(f"about {self._overall.left:.0f} s left")
