"""Guided edits on the command line, by a prompt, recordings or a material: guide, progress and previews."""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from avmsf.cli.clap_curve import CLAP, ClapCurve
from avmsf.cli.heartbeat import doing, verbosity
from avmsf.cli.options.edit import GuideOptions
from avmsf.cli.printing import console, figure, say
from avmsf.cli.writing import Level, write_sound
from avmsf.editing.distillation import DecoderDistillation
from avmsf.editing.guided import PARAMETERISATIONS, Guide, GuidedEditProgress, edit_towards
from avmsf.editing.material_statistics import MaterialStatistics
from avmsf.editing.modal_edit import EDITS
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.evaluation.clap import Clap
from avmsf.fem.material import Material, material_named
from avmsf.field.sound_field import SoundField

_PREVIEW = Level("peak", -1.0)
_GENERATED_SECONDS = 3.0
"""Duration of a sound that is generated from a prompt only."""


@dataclass(frozen=True)
class Steering(GuideOptions):
    """A guided edit towards a prompt, recordings, or the sound of a material; only one of them.

    A preview is written next to the output while it runs. An interrupted edit leaves its state there; the same command
    continues from it to the same result.
    """

    def apply(self, field: SoundField, *, output: Path, old: Material | None) -> SoundField:
        """Return the edited field; its state and preview are written next to `output`, its later file.

        `old` is the field's material, needed only for `like_material`.
        """
        preview, checkpoint = beside(output, "preview.wav"), beside(output, "checkpoint")
        curve: ClapCurve | None = None
        if self.clap is not None and self.prompt is not None:
            clap, kept = Clap.load(self.clap), beside(output, "clap.json")
            curve = ClapCurve(clap, self.prompt, field, kept, resumed=checkpoint.exists())
        # After CLAP: a wrong name of its network is refused before the large model is loaded.
        guide = self._guide(field, old)
        with SteerBar(preview, sample_rate=field.sample_rate) as bar:

            def progress(reached: GuidedEditProgress) -> None:
                if curve is not None:
                    curve.add(reached)
                bar.show(reached)

            edited = edit_towards(
                field, guide, config=self.config, parameters=PARAMETERISATIONS[self.parameters], progress=progress,
                checkpoint=checkpoint,
            )  # fmt: skip
        return edited if curve is None else _with_scores(edited, curve)

    def _guide(self, field: SoundField, old: Material | None) -> Guide:
        if self.like_material is not None:
            assert old is not None
            common = MaterialStatistics.transform(field, old, material_named(self.like_material))
            return common.reference(samples=field.samples, sample_rate=field.sample_rate, seed=self.config.seed)
        if self.prompt is None:
            return Reference.read(self.like, sample_rate=field.sample_rate)
        say(f"loading {self.model}")
        model = StableAudio.load(self.model, seconds=self.model_seconds, device=self.device)
        if self.generated is not None:
            seconds = _GENERATED_SECONDS if self.model_seconds is None else self.model_seconds
            made = model.generate(self.prompt, seconds=seconds, seed=self.config.seed, negative=self.negative)
            write_sound(self.generated, made, sample_rate=model.sample_rate, coding="float32")
        return DecoderDistillation(
            model,
            self.prompt,
            sample_rate=field.sample_rate,
            negative=self.negative,
            config=self.distillation,
        )


def _with_scores(field: SoundField, curve: ClapCurve) -> SoundField:
    """Return the field with the CLAP scores in the last entry of its edits."""
    *others, last = field.origin.report[EDITS]
    report = {**field.origin.report, EDITS: [*others, {**last, CLAP: curve.record()}]}
    return dataclasses.replace(field, origin=dataclasses.replace(field.origin, report=report))


class SteerBar:
    """A bar with the present loss and pitch, and a preview that is overwritten; in a file or a pipe, lines."""

    def __init__(self, preview: Path, *, sample_rate: float) -> None:
        self.preview, self.sample_rate, self.live = preview, sample_rate, sys.stderr.isatty()
        self.bar = Progress(
            TextColumn("editing"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("loss {task.fields[loss]}, pitch x {task.fields[pitch]}"),
            TimeRemainingColumn(),
            console=console(errors=True),
            disable=not self.live or verbosity.quiet,
        )
        self.task = self.bar.add_task("", total=None, loss="–", pitch="–")

    def __enter__(self) -> "SteerBar":
        self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()

    def show(self, progress: GuidedEditProgress) -> None:
        """Take note of one step."""
        loss, pitch = figure(progress.loss), figure(progress.pitch, 4)
        doing(f"step {progress.step} of {progress.steps}: loss {loss}, pitch x {pitch}")
        self.bar.update(self.task, completed=progress.step, total=progress.steps, loss=loss, pitch=pitch)
        if progress.preview is None:
            return
        factor = _PREVIEW.factor(progress.preview[None])
        write_sound(self.preview, factor * progress.preview, sample_rate=self.sample_rate, coding="float32")
        if not self.live:
            say(f"step {progress.step} of {progress.steps}: loss {loss}, pitch x {pitch}; preview in {self.preview}")


def beside(output: Path, ending: str) -> Path:
    """Return the path of a part of an unfinished edit: next to its later file."""
    return output.with_name(f"{output.name}.{ending}")
