"""An edit of a field by the options of `avmsf edit`, and what it did: a table of modes, notes, pictures and sounds."""

import math
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf._utils.text import counted, format_number
from avmsf.cli.contacts import contacts_on
from avmsf.cli.edit import Options
from avmsf.cli.output import decimals, display, doing, say, table
from avmsf.cli.render import peak_factor, write_sound
from avmsf.cli.report import MAX_LISTED_MODES
from avmsf.editing.distillation import DecoderDistillation
from avmsf.editing.guided import CLAP, PARAMETERIZATIONS, Guide, GuidedEditProgress, edit_towards
from avmsf.editing.material import edit, infer_material
from avmsf.editing.modal_edit import mode_at, remarks
from avmsf.editing.reference import Reference
from avmsf.editing.stable_audio import StableAudio
from avmsf.evaluation.clap import Clap
from avmsf.fem.material import Material, material_named
from avmsf.field.sound_field import SoundField
from avmsf.plotting.edits import draw_clap_curves, draw_edit
from avmsf.plotting.pictures import draw_spectrograms, save_picture

_CANDIDATES = 64
"""Points of the surface among which the loudest is looked for."""
_LOUD_NOISE_DB = 6.0
"""Decrease of the modes' level, dB, from which on the noise, whose level stays, may be too loud: half the amplitude."""
_FieldAt = tuple[SoundField, Float64[Tensor, " 3"]]
"""A field and a contact on it, meters."""


def edited(options: Options, field: SoundField) -> SoundField:
    """Return the edited field: material, size and modes by `edit`, then the guided edit."""
    settings, old = options.all_settings, None
    new = None if options.to is None else material_named(options.to)
    if options.old is not None:
        old = material_named(options.old)
    elif options.changes_material or options.like_material is not None:
        old, words = infer_material(field, option="--from", new=new)
        say(words)
    target = new or old if options.changes_material else None
    if target is not None and (constants := settings.material.constants):
        target = replace(target, name=f"{target.name} with {', '.join(constants)} changed", **constants)
    if options.changes_material or options.changes_modes:
        adjusted = _adjustments(options, field) if options.changes_modes else dict[str, Any]()
        law = settings.material.law
        field = edit(field, material=target, old_material=old, size=options.scale, law=law, **adjusted)
    return _guided(options, field, target or old) if options.guides else field


def _adjustments(options: Options, field: SoundField) -> dict[str, Any]:
    """Return what `edit` does with each mode by hand; modes are called by their frequencies, Hz."""
    levels = torch.zeros(len(field.bank), dtype=torch.float64)
    pitch, decay = torch.full_like(levels, options.pitch), torch.full_like(levels, options.decay)
    for frequency, level in options.mode_db:
        levels[mode_at(field.bank, frequency, option="--mode-db")] += level
    for frequency, factor in options.mode_pitch:
        pitch[mode_at(field.bank, frequency, option="--mode-pitch")] *= factor
    for frequency, factor in options.mode_decay:
        decay[mode_at(field.bank, frequency, option="--mode-decay")] *= factor
    return {"pitch": pitch, "decay": decay, "brightness_db": options.brightness, "gains_db": levels}


def _guided(options: Options, field: SoundField, old: Material | None) -> SoundField:
    """Return the field edited towards a prompt, recordings, or the sound of a material in place of `old`."""
    settings, preview, score = options.all_settings, options.part("preview.wav"), None
    if settings.prompt.clap is not None and options.prompt is not None:
        score = Clap.load(settings.prompt.clap).of_previews(options.prompt, field.sample_rate)
    # After CLAP: a wrong name of its network is refused before the large model is loaded.
    guide: Guide
    if options.prompt is not None:
        guide = _prompted(options.prompt, options, field.sample_rate)
    elif options.like_material is not None:
        assert old is not None
        guide = Reference.of_material(field, old, material_named(options.like_material), seed=settings.guide.seed)
    else:
        guide = Reference.read(options.like, sample_rate=field.sample_rate)

    def progress(reached: GuidedEditProgress) -> None:
        message = f"loss {format_number(reached.loss)}, pitch x {format_number(reached.pitch, 4)}"
        if reached.preview is not None:
            sound = peak_factor(reached.preview[None]) * reached.preview
            write_sound(preview, sound, sample_rate=field.sample_rate)
            say(f"edit: step {reached.step} of {reached.steps}, {message}; preview in {preview}")
        display.step("edit", reached.step, reached.steps, message)

    return edit_towards(
        field, guide, config=settings.guide, parameters=PARAMETERIZATIONS[settings.parameters], progress=progress,
        score=score, checkpoint=options.part("checkpoint"),
    )  # fmt: skip


def _prompted(prompt: str, options: Options, sample_rate: float) -> DecoderDistillation:
    """Return the guide by a text; write the sound of the text alone where that is asked for."""
    settings = options.all_settings.prompt
    doing(f"loading {options.model}")
    model = StableAudio.load(options.model, seconds=settings.model_seconds, device=settings.device)
    if settings.generated is not None:
        # Seconds of a sound that is generated from a prompt only.
        seconds = 3.0 if settings.model_seconds is None else settings.model_seconds
        made = model.generate(prompt, seconds=seconds, seed=options.all_settings.guide.seed)
        write_sound(settings.generated, made, sample_rate=model.sample_rate)
    return DecoderDistillation(model, prompt, sample_rate=sample_rate, config=settings.distillation)


def mode_changes(old: SoundField, new: SoundField) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return what became of each mode, and of each supporting pole, in the field's order."""
    columns = {
        "frequency_before": old.bank.frequency,
        "frequency_after": new.bank.frequency,
        "t60_before": old.bank.t60,
        "t60_after": new.bank.t60,
        "level_change_db": 20.0 * (new.amplitudes / old.amplitudes).log10(),
        "silent": new.amplitudes == 0.0,
    }
    cells = zip(*(column.tolist() for column in columns.values()), strict=True)
    rows = [dict(zip(columns, row, strict=True)) for row in cells]
    return list(compress(rows, new.is_mode.tolist())), list(compress(rows, (~new.is_mode).tolist()))


def changes_table(rows: list[dict[str, Any]], old: SoundField, new: SoundField) -> str:
    """Return the rows of the modes of most energy, before or after, as a table."""
    before, after = (field.amplitudes.square() * field.bank.t60 for field in (old, new))
    energy = before.maximum(after)[new.is_mode]
    listed = energy.argsort(descending=True)[:MAX_LISTED_MODES].sort().values.tolist()
    cells = []
    for row in (rows[place] for place in listed):
        change = row["level_change_db"]
        level = "silent" if row["silent"] else decimals(change, 1) if math.isfinite(change) else "back"
        frequencies = [format_number(row[f"frequency_{when}"], 5) for when in ("before", "after")]
        cells.append([*frequencies, *(format_number(row[f"t60_{when}"]) for when in ("before", "after")), level])
    title = f"the {MAX_LISTED_MODES} modes of most energy among {len(rows)}"
    if len(rows) <= MAX_LISTED_MODES:
        title = counted(len(rows), "mode")
    columns = ["before (Hz)", "after (Hz)", "T60 before (s)", "T60 after (s)", "level change (dB)"]
    return table(f"{title}, before and after", columns, cells, words=0)


def notes_on(edits: list[dict[str, Any]], old: SoundField, new: SoundField, *, scale: float) -> list[str]:
    """Return what a user of an edited field should know."""
    notes = [*remarks(edits, new)]
    for law in (each["law"] for each in edits if "law" in each):
        other = "" if law == "acceleration" else "; of microphones close to the object: --set material.law=acceleration"
        notes.append(f"gains by the law of recordings in proportion to {law}{other} (docs/editing.md)")
    seconds = new.samples / new.sample_rate
    before, ringing = (max([0.0, *field.bank.t60[field.amplitudes > 0].tolist()]) for field in (old, new))
    if ringing > max(seconds, before):
        notes.append(
            f"the longest T60 is {format_number(ringing)} s and rendered sounds last {format_number(seconds)} s; "
            f"render and export with --seconds {math.ceil(10 * ringing) / 10:g}"
        )
    if scale != 1.0:
        notes.append(f"positions on the edited object are {scale:g} times as large")
    softer = 20.0 * float((old.amplitudes.norm() / new.amplitudes.norm()).log10())
    if _LOUD_NOISE_DB < softer < math.inf and bool(new.residual.magnitude.any()):
        notes.append(f"the modes are {softer:.0f} dB softer and the noise is as loud as before; render with --no-noise")
    return notes


def contact_of_sounds(field: SoundField, at: tuple[float, float, float] | None) -> Float64[Tensor, " 3"]:
    """Return the contact of the sounds: the requested one, or the loudest of some."""
    if at is not None:
        return contacts_on(field, [at], unit="m", advice=", in meters").places[0]
    points = field.gain_field.points
    some = points[:: max(1, len(points) // _CANDIDATES)]
    energy = (field.known(some).power * field.audible / field.bank.damping).sum(1)
    return some[int(energy.argmax())].double()


def draw(folder: Path, before: _FieldAt, after: _FieldAt, last: dict[str, Any]) -> None:
    """Write pictures and sounds of both fields at a place each, by one factor, and the CLAP scores of the last edit."""
    old, new = before[0], after[0]
    name, rate = old.origin.capture or "field", old.sample_rate
    sounds = torch.cat([field.render(place[None]) for field, place in (before, after)])
    pictures = {
        "modes.png": draw_edit(old, new, title=f"modes of {name}, edited"),
        "spectrograms.png": draw_spectrograms(
            {"": {"before": sounds[0], "after": sounds[1]}},
            ("before", "after"),
            sample_rate=rate,
            title=f"an impact at {name}, edited",
        ),
    }
    if CLAP in last:
        curve = list(zip(last[CLAP]["steps"], last[CLAP]["scores"], strict=True))
        pictures["clap.png"] = draw_clap_curves({last["parameters"]: [curve]}, title=f"CLAP score: {last['prompt']}")
    for each, picture in pictures.items():
        save_picture(picture, folder / each)
    wavs = dict(zip(("before.wav", "after.wav"), peak_factor(sounds) * sounds, strict=True))
    for each, sound in wavs.items():
        write_sound(folder / each, sound, sample_rate=rate)
    say(f"wrote {', '.join((*pictures, *wavs))} in {folder}")
