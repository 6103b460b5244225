"""The process of long computations for the page: `python -m avmsf.studio.worker`.

It reads one line of JSON, the task, and writes lines of JSON: {"stage", "done", "total", "words"} as progress, with
"loss" (null for none) and "pitch" at each step of an optimization, and {"result"} or {"error"} at the end. It ends,
with all that it has started, when its standard input is closed.
"""

import json
import math
import os
import signal
import sys
import threading
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from avmsf._utils.files import copy_whole
from avmsf._utils.processes import end_with_parent
from avmsf._utils.progress import ProgressListener
from avmsf.capture import read_capture
from avmsf.capture.settings import settings_of
from avmsf.editing.config import GuidedEditConfig
from avmsf.editing.guided import GuidedEditProgress, edit_towards
from avmsf.editing.reference import Reference
from avmsf.errors import NO_MEMORY, AvmsfError, CaptureWarning, lacks_memory
from avmsf.field.store import load, save
from avmsf.pipeline.config import CACHE, PRESETS, SceneConfig
from avmsf.pipeline.fit import fit_in_stages
from avmsf.pipeline.scene import CLOUD, SceneStages
from avmsf.pipeline.stages import StageFolder
from avmsf.studio.capture import COMMAND

Values = Mapping[str, Any]


class EventWriter:
    """Sends progress events to the server."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream
        self.listener = ProgressListener(self.log, self._stage_step, note=self.log)
        """What the stages of a fit report to."""

    def write(self, **event: Any) -> None:
        """Write one event."""
        self.stream.write(json.dumps(event) + "\n")
        self.stream.flush()

    def log(self, words: str) -> None:
        """Send that a stage begins: its name before the colon, a description after it."""
        stage, _, rest = words.partition(": ")
        self.write(stage=stage, done=0, total=0, words=rest)

    def guided_edit(self, progress: GuidedEditProgress) -> None:
        """Send the progress of an edit's optimization."""
        words = f"loss {progress.loss:.3g}, pitch x {progress.pitch:.4g}"
        # In JSON there is no NaN.
        loss = progress.loss if math.isfinite(progress.loss) else None
        step = {"stage": "edit", "done": progress.step, "total": progress.steps, "words": words}
        self.write(**step, loss=loss, pitch=progress.pitch)

    def _stage_step(self, stage: str, done: int, total: int, words: str) -> None:
        if done % 10 == 0 or done == total or stage == "features":
            self.write(stage=stage, done=done, total=total, words=words)


def make_field(task: Values, events: EventWriter) -> Values:
    """Reconstruct the capture `folder`, copy its field to `output`, and return both files.

    The copy is the field of this reconstruction, even if another one replaces `field` meanwhile.
    """
    folder = Path(task["folder"])
    config = PRESETS[task["preset"]]
    settings = settings_of(folder).starting(config.time_zero)
    events.log("capture: reading the recordings")
    capture, stages = read_capture(folder, settings), StageFolder(folder / CACHE)
    with stages.lock(COMMAND):
        made = fit_in_stages(capture, config, stages, listener=events.listener)
        copy_whole(made.field, Path(task["output"]))
    return {"field": str(made.field), "output": task["output"]}


def make_object(task: Values, events: EventWriter) -> Values:
    """Make Gaussians of what the capture `folder` shows of its object, and return their file."""
    folder = Path(task["folder"])
    stages = StageFolder(folder / CACHE)
    scene = SceneStages(folder, stages, SceneConfig(), settings=settings_of(folder), listener=events.listener)
    scene.expect_any()
    with stages.lock(COMMAND):
        return {"object": str(scene[CLOUD].path)}


def lead(task: Values, events: EventWriter) -> Values:
    """Optimize a field towards a recording, and return the file of the edited one."""
    field = load(task["field"])
    guide = Reference.read(task["recording"], sample_rate=field.sample_rate)
    config = GuidedEditConfig(steps=int(task["steps"]), preview_every=0)
    save(edit_towards(field, guide, config=config, progress=events.guided_edit), task["output"])
    return {"output": task["output"]}


_TASKS = {"make_field": make_field, "make_object": make_object, "lead": lead}


def main() -> int:
    """Do the task of the standard input's first line."""
    events = EventWriter(os.fdopen(os.dup(1), "w", encoding="utf-8"))
    # What libraries print is no event.
    os.dup2(2, 1)
    task = json.loads(sys.stdin.readline())
    threading.Thread(target=end_with_parent, daemon=True).start()
    # Ctrl-C is the server's, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with warnings.catch_warnings():
        warnings.simplefilter("always", CaptureWarning)
        warnings.showwarning = lambda message, *rest, **more: events.write(stage="note", words=str(message))
        try:
            events.write(result=_TASKS[task["task"]](task, events))
        except Exception as error:
            if not (isinstance(error, AvmsfError) or lacks_memory(error)):
                raise
            message = str(error) if isinstance(error, AvmsfError) else NO_MEMORY
            events.write(error=" ".join(message.split()))
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
