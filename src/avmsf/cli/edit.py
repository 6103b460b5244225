"""`avmsf edit`: a field in, the field of another material, size, pitch or sound out."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich.table import Table
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.text import counted, format_number, read_json
from avmsf.cli import INTERRUPTED
from avmsf.cli.contacts import contacts_at, refuse_far
from avmsf.cli.options.edit import AFTER, BEFORE, CURVE, MODES, SPECTROGRAMS, EditSettings, Options
from avmsf.cli.printing import console, decimals, next_command, print_json, say, table
from avmsf.cli.progress import ProgressBar
from avmsf.cli.writing import Level, write_sound
from avmsf.editing.distillation import DecoderDistillation
from avmsf.editing.guided import PARAMETERIZATIONS, Guide, GuidedEditProgress, edit_towards
from avmsf.editing.material import LAWS, edit, infer_material
from avmsf.editing.modal_edit import EDITS, remarks, silenced
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import EditError
from avmsf.evaluation.clap import Clap
from avmsf.fem.material import Material, material_named
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.plotting.edits import ModeLevels, draw_clap_curves, draw_edit
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.spectrograms import draw_spectrograms

CLAP = "clap"
"""The key of the scores in the last edit of a field's report."""
_PREVIEW = Level("peak", -1.0)
_GENERATED_SECONDS = 3.0
"""Duration of a sound that is generated from a prompt only."""
_LISTED = 20
"""Modes in the table, those of most energy."""
_CANDIDATES = 64
"""Points of the surface among which the loudest is looked for."""
_NEAR = 0.02
"""By which part a mode's frequency may be off the one that it is called by."""

_LOUD_NOISE_DB = 6.0
"""Decrease of the modes' level, dB, from which on the noise, whose level stays, may be too loud: half the amplitude."""


def _adjustments(options: Options, named: Float[Tensor, " modes"]) -> dict[str, Any]:
    """Return what `edit` does with each mode by hand; modes are called by the frequencies `named`, Hz."""
    levels = torch.zeros(len(named), dtype=torch.float64)
    pitch, decay = torch.full_like(levels, options.pitch), torch.full_like(levels, options.decay)
    for frequency, level in options.mode_db:
        levels[_called(frequency, named, "--mode-db")] += level
    for option, values, given in (
        ("--mode-pitch", pitch, options.mode_pitch),
        ("--mode-decay", decay, options.mode_decay),
    ):
        for frequency, factor in given:
            values[_called(frequency, named, option)] *= factor
    return {"pitch": pitch, "decay": decay, "brightness_db": options.brightness, "gains_db": levels}


def _called(frequency: float, named: Float[Tensor, " modes"], option: str) -> int:
    """Return the index of the mode at a frequency. Raises EditError where there is none."""
    row = int((named - frequency).abs().argmin())
    if not abs(float(named[row]) - frequency) <= _NEAR * float(named[row]):
        got, advice = f"{frequency:g} Hz", f"the nearest is at {float(named[row]):.5g} Hz (`avmsf info` lists them)"
        raise EditError.expected("the frequency of a mode", frequency, got=got, name=option, advice=advice)
    return row


def run(options: Options) -> int:
    """Edit, write, and print the result; return 130 where Ctrl-C stopped it."""
    old = load(options.field)
    contact = _contact(old, options.position)
    try:
        new = _edited(options, old)
    except KeyboardInterrupt:
        kept = _next_to(options.output, "checkpoint")
        where = f"from {kept}, or delete it" if kept.exists() else "from the start"
        say(f"avmsf edit: interrupted; run the same command again to continue {where}")
        return INTERRUPTED
    save(new, options.output)
    if options.guides:
        for ending in ("checkpoint", "preview.wav", "clap.json"):
            _next_to(options.output, ending).unlink(missing_ok=True)
    edits = new.origin.report[EDITS][len(old.origin.report.get(EDITS, [])) :]
    before, after = ModeLevels.of(old), ModeLevels.of(new)
    screen = console(errors=options.json)
    screen.print(_table(before, after))
    for words in remarks(edits, new):
        screen.print(f"note: {words}", soft_wrap=True)
    seconds, ringing = new.samples / new.sample_rate, _longest(after)
    if ringing > max(seconds, _longest(before)):
        screen.print(
            f"note: the longest T60 is {format_number(ringing)} s and rendered sounds last {format_number(seconds)} s; "
            f"render and export with --seconds {math.ceil(10 * ringing) / 10:g}",
            soft_wrap=True,
        )
    if options.scale != 1.0:
        screen.print(f"note: positions on the edited object are {options.scale:g} times as large", soft_wrap=True)
    softer = _level(before) - _level(after)
    if _LOUD_NOISE_DB < softer < math.inf and bool(new.residual.magnitude.any()):
        screen.print(
            f"note: the modes are {softer:.0f} dB softer and the residual noise is as loud as before; `avmsf render "
            "--no-noise` leaves it out",
            soft_wrap=True,
        )
    if options.plots is not None:
        _show(options.plots, (old, contact), (new, options.scale * contact))
        if CLAP in edits[-1]:
            _show_scores(options.plots / CURVE, edits[-1])
    screen.print(f"wrote {options.output}", soft_wrap=True)
    if options.json:
        print_json(
            {
                "field": str(options.field),
                "output": str(options.output),
                "capture": new.origin.capture,
                "edits": edits,
                "silent_modes": int(silenced(new).sum()),
                "modes": _rows(before, after),
            }
        )
    next_command("avmsf render", options.output, "--position X Y Z -o impact.wav")
    return 0


def _edited(options: Options, field: SoundField) -> SoundField:
    """Return the edited field: material, size and modes by `edit`, then the guided edit."""
    settings = options.all_settings
    old: Material | None = None
    target: Material | None = None
    if options.changes_material or options.like_material is not None:
        new = None if options.to is None else material_named(options.to)
        old = old_material(field, new=new) if options.old is None else material_named(options.old)
    if options.changes_material and old is not None:
        target = old if options.to is None else material_named(options.to)
        if constants := settings.material.constants:
            target = replace(target, name=f"{target.name} with {', '.join(constants)} changed", **constants)
    if options.changes_material or options.changes_modes:
        adjusted = _adjustments(options, field.bank.frequency) if options.changes_modes else dict[str, Any]()
        law = LAWS[settings.material.law]
        field = edit(field, material=target, old_material=old, size=options.scale, law=law, **adjusted)
    return _guided(options, settings, field, target or old) if options.guides else field


def old_material(field: SoundField, *, new: Material | None = None) -> Material:
    """Return a field's material, and print its source. Raises `EditError` where no material fits."""
    material, words = infer_material(field, option="--from", new=new)
    say(words)
    return material


def _guided(options: Options, settings: EditSettings, field: SoundField, old: Material | None) -> SoundField:
    """Return the field edited towards a prompt, recordings, or the sound of a material.

    State and preview are written next to the output, so that the same command continues to the same result. `old` is
    the field's material, needed only for `like_material`.
    """
    preview, checkpoint = _next_to(options.output, "preview.wav"), _next_to(options.output, "checkpoint")
    curve: ClapCurve | None = None
    if settings.prompt.clap is not None and options.prompt is not None:
        clap, kept = Clap.load(settings.prompt.clap), _next_to(options.output, "clap.json")
        curve = ClapCurve(clap, options.prompt, field, kept, resumed=checkpoint.exists())
    # After CLAP: a wrong name of its network is refused before the large model is loaded.
    guide = _guide(options, settings, field, old)
    with ProgressBar() as bar:

        def progress(reached: GuidedEditProgress) -> None:
            if curve is not None:
                curve.add(reached)
            message = f"loss {format_number(reached.loss)}, pitch x {format_number(reached.pitch, 4)}"
            if reached.preview is not None:
                factor = _PREVIEW.factor(reached.preview[None])
                write_sound(preview, factor * reached.preview, sample_rate=field.sample_rate, coding="float32")
                message += f"; preview in {preview}"
            bar.step("edit", reached.step, reached.steps, message)

        edited = edit_towards(
            field, guide, config=settings.guide, parameters=PARAMETERIZATIONS[settings.parameters], progress=progress,
            checkpoint=checkpoint,
        )  # fmt: skip
    if curve is None:
        return edited
    *others, last = edited.origin.report[EDITS]
    report = {**edited.origin.report, EDITS: [*others, {**last, CLAP: curve.record()}]}
    return replace(edited, origin=replace(edited.origin, report=report))


def _guide(options: Options, settings: EditSettings, field: SoundField, old: Material | None) -> Guide:
    prompted, seed = settings.prompt, settings.guide.seed
    if options.like_material is not None:
        assert old is not None
        return Reference.of_material(field, old, material_named(options.like_material), seed=seed)
    if options.prompt is None:
        return Reference.read(options.like, sample_rate=field.sample_rate)
    say(f"loading {options.model}")
    model = StableAudio.load(options.model, seconds=prompted.model_seconds, device=prompted.device)
    if prompted.generated is not None:
        seconds = _GENERATED_SECONDS if prompted.model_seconds is None else prompted.model_seconds
        made = model.generate(options.prompt, seconds=seconds, seed=seed, negative=prompted.negative)
        write_sound(prompted.generated, made, sample_rate=model.sample_rate, coding="float32")
    return DecoderDistillation(
        model,
        options.prompt,
        sample_rate=field.sample_rate,
        negative=prompted.negative,
        config=prompted.distillation,
    )


def _next_to(output: Path, ending: str) -> Path:
    """Return the path of a part of an unfinished edit: next to its later file."""
    return output.with_name(f"{output.name}.{ending}")


class ClapCurve:
    """The CLAP score of a field's sound at one contact over the steps of an edit; step 0 is the unedited field."""

    def __init__(self, clap: Clap, prompt: str, field: SoundField, kept: Path, *, resumed: bool) -> None:
        """Start a curve, or with `resumed` continue that of the file `kept`.

        Raises EditError for a file that is damaged or has scores of another network.
        """
        self.clap, self.prompt, self.field, self.kept = clap, prompt, field, kept
        self.scores = _read_scores(kept, clap) if resumed and kept.is_file() else {}

    def add(self, progress: GuidedEditProgress) -> None:
        """Score a preview, and the unedited field before the first one. Silent sounds have no score."""
        if progress.preview is None or progress.place is None:
            return
        if not self.scores:
            self._score(0, self.field.render(progress.place[None])[0])
        self._score(progress.step, progress.preview)
        text = json.dumps({"digest": self.clap.digest, "scores": list(self.scores.items())})
        write_whole(self.kept, text, raising=EditError)

    def record(self) -> dict[str, Any]:
        """Return the steps and scores as plain values."""
        return {"model": self.clap.name, "steps": [*self.scores], "scores": [*self.scores.values()]}

    def _score(self, step: int, sound: Float[Tensor, " samples"]) -> None:
        if bool(sound.any()):
            self.scores[step] = float(self.clap.score(sound[None], [self.prompt], sample_rate=self.field.sample_rate))


def _read_scores(path: Path, clap: Clap) -> dict[int, float]:
    try:
        read = read_json(path)
        scores = {int(step): float(score) for step, score in read["scores"]}
        digest = read["digest"]
    except (OSError, ValueError, TypeError, KeyError) as error:
        advice = "delete the file to continue"
        raise EditError.expected("CLAP scores", got=str(error), file=path, advice=advice) from error
    if digest != clap.digest:
        wanted, got = f"scores of {clap.name}", "those of another network"
        raise EditError.expected(wanted, digest, got=got, file=path, name="digest", advice="give that network")
    return scores


def _contact(field: SoundField, at: tuple[float, float, float] | None) -> Float[Tensor, " 3"]:
    """Return the contact of the sounds: the requested one, or the loudest of some."""
    if at is not None:
        chosen = contacts_at([at], meters=1.0)
        refuse_far(chosen, field, advice=", in meters")
        return chosen.places[0].double()
    points = field.gain_field.points
    some = points[:: max(1, len(points) // _CANDIDATES)]
    energy = (field.known(some).power * field.audible / field.bank.damping).sum(1)
    return some[int(energy.argmax())].double()


def _show(
    folder: Path, before: tuple[SoundField, Float[Tensor, " 3"]], after: tuple[SoundField, Float[Tensor, " 3"]]
) -> None:
    """Write pictures and sounds of both fields at a place each; sounds by one factor, so that levels compare."""
    old, new = before[0], after[0]
    name = old.origin.capture or "field"
    sounds = torch.cat([field.render(place[None]) for field, place in (before, after)])
    modes = draw_edit(
        ModeLevels.of(old), ModeLevels.of(new), sample_rate=old.sample_rate, title=f"modes of {name}, edited"
    )
    pictures = {
        MODES: modes,
        SPECTROGRAMS: draw_spectrograms(
            *sounds[:, None],
            sample_rate=old.sample_rate,
            names=[""],
            title=f"an impact at {name}, edited",
            columns=("before", "after"),
            shared_scale=False,
        ),
    }
    for each, picture in pictures.items():
        save_picture(picture, folder / each)
    factor = Level("peak", -1.0).factor(sounds)
    for each, sound in zip((BEFORE, AFTER), sounds, strict=True):
        write_sound(folder / each, factor * sound, sample_rate=old.sample_rate, coding="float32")
    for each in (*pictures, BEFORE, AFTER):
        say(f"wrote {folder / each}")


def _show_scores(path: Path, edit: dict[str, Any]) -> None:
    """Draw the CLAP scores of an edit over its steps."""
    curve = list(zip(edit[CLAP]["steps"], edit[CLAP]["scores"], strict=True))
    save_picture(draw_clap_curves({edit["parameters"]: [curve]}, title=f"CLAP score: {edit['prompt']}"), path)
    say(f"wrote {path}")


def _rows(before: ModeLevels, after: ModeLevels) -> list[dict[str, Any]]:
    """Return what became of each mode, in the field's order."""
    change = 20.0 * torch.log10(after.size / before.size)
    columns = (before.frequency, after.frequency, before.t60, after.t60, change)
    names = ("frequency_before", "frequency_after", "t60_before", "t60_after", "level_change_db")
    return [
        {**dict(zip(names, row, strict=True)), "silent": size == 0.0}
        for *row, size in zip(*(column.tolist() for column in columns), after.size.tolist(), strict=True)
    ]


def _longest(modes: ModeLevels) -> float:
    """Return the longest T60 of the modes that sound, s; zero without one."""
    return float(torch.where(modes.size > 0, modes.t60, 0.0).max())


def _level(modes: ModeLevels) -> float:
    """Return the level of all modes together, dB; -inf without one that sounds."""
    return float(20.0 * torch.log10(modes.size.norm()))


def _change(row: dict[str, Any]) -> str:
    if row["silent"]:
        return "silent"
    return decimals(row["level_change_db"], 1) if math.isfinite(row["level_change_db"]) else "back"


def _table(before: ModeLevels, after: ModeLevels) -> Table:
    energy = torch.maximum(*(modes.size.square() * modes.t60 for modes in (before, after)))
    listed = torch.argsort(energy, descending=True)[:_LISTED].sort().values.tolist()
    rows = _rows(before, after)
    cells = [
        [
            format_number(row["frequency_before"], 5),
            format_number(row["frequency_after"], 5),
            format_number(row["t60_before"]),
            format_number(row["t60_after"]),
            _change(row),
        ]
        for row in (rows[place] for place in listed)
    ]
    title = (
        counted(len(rows), "mode") if len(rows) <= _LISTED else f"the {_LISTED} modes of most energy among {len(rows)}"
    )
    columns = ["before (Hz)", "after (Hz)", "T60 before (s)", "T60 after (s)", "level change (dB)"]
    return table(f"{title}, before and after", columns, cells, words=0)
