"""An edit towards words or recordings, as the command line has it: its guide, its progress, its previews."""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Annotated, TextIO

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from avmsf.cli.printing import figure, say
from avmsf.cli.writing import Level, write_sound
from avmsf.errors import EditError
from avmsf.field.soundfield import SoundField
from avmsf.tasks.distillation import DecoderDistillation
from avmsf.tasks.reference import Reference
from avmsf.tasks.stableaudio import StableAudio
from avmsf.tasks.stableaudiofiles import STABLE_AUDIO
from avmsf.tasks.steer import Guide, SteerConfig, SteerProgress, steer

_PREVIEW = Level("peak", -1.0)


@dataclass(frozen=True)
class Steering:
    """A descent towards a prompt, or towards recordings; only one of them.

    While it runs, the sound as it stands can be heard beside the output. An interrupted edit leaves its state there;
    the same command goes on from it to the same result.
    """

    prompt: str | None = None
    """Lead the sound towards these words, as "a wooden bowl is hit", by a text-to-audio model; needs the extra
    `text`."""
    like: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="WAV|FOLDER")] = ()
    """Lead the sound towards recordings of blows on another object, files or folders of them."""
    model: str = STABLE_AUDIO
    """Folder that holds a Stable Audio pipeline, or its name on the hub."""
    negative: str | None = None
    """Words to lead away from."""
    guidance: float = 15.0
    """How many times the step from no words to the prompt is taken; up to 60 has been used."""
    denoising: int = 4
    """Denoising steps for a target, 2 to 10."""
    batch: int = 10
    """Sounds that the model is given at once; halved where memory runs out."""
    model_seconds: float | None = None
    """Seconds that the model works at; all that it was made for where not given, which costs in proportion."""
    device: str | None = None
    """Where the model computes: cuda, cpu; the GPU where there is one."""
    config: tyro.conf.OmitArgPrefixes[SteerConfig] = field(default_factory=SteerConfig)

    @property
    def asked(self) -> bool:
        """Whether there is anything to lead to."""
        return self.prompt is not None or bool(self.like)

    def expect_one(self) -> None:
        """Raise `EditError` for both a prompt and recordings, and for an empty prompt: before a model is loaded."""
        if self.prompt is not None and self.like:
            raise EditError("expected --prompt or --like, found both: edit by one, then by the other")
        if self.prompt is not None and not self.prompt.strip():
            raise EditError('--prompt is empty: describe the sound, such as "a wooden bowl is hit"')

    def apply(self, field: SoundField, *, output: Path) -> SoundField:
        """Return the edited field; `output` is where it will be written, and its state and preview lie beside it."""
        guide = self._guide(field)
        preview = beside(output, "preview.wav")
        with SteerBar(preview, sample_rate=field.sample_rate) as bar, _remarks_as_notes():
            return steer(field, guide, config=self.config, progress=bar.show, checkpoint=beside(output, "checkpoint"))

    def _guide(self, field: SoundField) -> Guide:
        if self.prompt is None:
            return Reference.read(self.like, sample_rate=field.sample_rate)
        say(f"loading {self.model}")
        return DecoderDistillation(
            StableAudio.load(self.model, seconds=self.model_seconds, device=self.device),
            self.prompt,
            sample_rate=field.sample_rate,
            negative=self.negative,
            guidance=self.guidance,
            steps=self.denoising,
            batch=self.batch,
        )


class SteerBar:
    """A bar with the loss and the pitch so far, and a preview that is written over; in a file or a pipe, lines."""

    def __init__(self, preview: Path, *, sample_rate: float) -> None:
        self.preview, self.sample_rate, self.live = preview, sample_rate, sys.stderr.isatty()
        self.bar = Progress(
            TextColumn("editing"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("loss {task.fields[loss]}, pitch x {task.fields[pitch]}"),
            TimeRemainingColumn(),
            console=Console(file=sys.stderr, markup=False, highlight=False),
            disable=not self.live,
        )
        self.task = self.bar.add_task("", total=None, loss="–", pitch="–")

    def __enter__(self) -> "SteerBar":
        self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    def show(self, progress: SteerProgress) -> None:
        """Take note of one step."""
        loss, pitch = figure(progress.loss), figure(progress.pitch, 4)
        self.bar.update(self.task, completed=progress.step, total=progress.steps, loss=loss, pitch=pitch)
        if progress.preview is None:
            return
        factor = _PREVIEW.factor(progress.preview[None])
        write_sound(self.preview, factor * progress.preview, sample_rate=self.sample_rate, coding="float32")
        if not self.live:
            say(f"step {progress.step} of {progress.steps}: loss {loss}, pitch x {pitch}; listen: {self.preview}")


def beside(output: Path, ending: str) -> Path:
    """Return where a part of an unfinished edit is kept: beside the field that it will become."""
    return output.with_name(f"{output.name}.{ending}")


@contextmanager
def _remarks_as_notes() -> Iterator[None]:
    """Let what an edit warns of appear as a sentence, without Python's file, line and category."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if category is UserWarning and Path(filename).parent.parent.name == "avmsf":
                say(f"note: {message}")
            else:
                others(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield
