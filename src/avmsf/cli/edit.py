"""`avmsf edit`: a field in, the field of another material, size, pitch or sound out."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich.table import Table
from torch import Tensor

from avmsf._utils.wording import counted
from avmsf.capture.settings import METRES
from avmsf.cli import INTERRUPTED
from avmsf.cli.clap_curve import CLAP
from avmsf.cli.contacts import contacts_at, refuse_far
from avmsf.cli.edit_material import MaterialChange
from avmsf.cli.options.common import Unit
from avmsf.cli.options.edit import AFTER, BEFORE, CURVE, MODES, SPECTROGRAMS, ModeOptions, Options
from avmsf.cli.printing import console, decimals, figure, next_command, print_json, say, table
from avmsf.cli.steering import Steering, beside
from avmsf.cli.writing import Level, write_sound
from avmsf.editing.modal_edit import EDITS, adjust_modes, remarks, silenced
from avmsf.errors import EditError
from avmsf.field.sound_field import SoundField
from avmsf.field.store import load, save
from avmsf.plotting.edits import ModeLevels, draw_clap_curves, draw_edit
from avmsf.plotting.pictures import save_picture
from avmsf.plotting.spectrograms import draw_sound_change

_LISTED = 20
"""Modes in the table, those of most energy."""
_CANDIDATES = 64
"""Points of the surface among which the loudest is looked for."""
_NEAR = 0.02
"""By which part a mode's frequency may be off the one that it is called by."""

_LOUD_NOISE_DB = 6.0
"""Decrease of the modes' level, dB, from which on the noise, whose level stays, may be too loud: half the amplitude."""


@dataclass(frozen=True)
class Sliders(ModeOptions):
    """Every mode by hand."""

    def apply(self, field: SoundField, *, named: Float[Tensor, " modes"]) -> SoundField:
        """Return the adjusted field; modes are called by the frequencies `named`, Hz."""
        levels = torch.zeros(len(named), dtype=torch.float64)
        pitch, decay = torch.full_like(levels, self.pitch), torch.full_like(levels, self.decay)
        for frequency, level in self.mode_db:
            levels[_called(frequency, named, "--mode-db")] += level
        for option, values, given in (
            ("--mode-pitch", pitch, self.mode_pitch),
            ("--mode-decay", decay, self.mode_decay),
        ):
            for frequency, factor in given:
                values[_called(frequency, named, option)] *= factor
        return adjust_modes(field, pitch=pitch, decay=decay, brightness_db=self.brightness, gains_db=levels)


def _called(frequency: float, named: Float[Tensor, " modes"], option: str) -> int:
    """Return the index of the mode at a frequency. Raises EditError where there is none."""
    row = int((named - frequency).abs().argmin())
    if not abs(float(named[row]) - frequency) <= _NEAR * float(named[row]):
        raise EditError(
            f"{option}: expected the frequency of a mode, got {frequency:g} Hz; the nearest is at "
            f"{float(named[row]):.5g} Hz (`avmsf info` lists them)",
            name=option,
            value=frequency,
        )
    return row


def run(options: Options) -> int:
    """Edit, write, and print the result; return 130 where Ctrl-C stopped it."""
    asked = _Edit.of(options)
    old = load(options.field)
    contact = _contact(old, options.position, unit=options.unit)
    try:
        new = _edited(options, asked, old)
    except KeyboardInterrupt:
        kept = beside(options.output, "checkpoint")
        where = f"from {kept}, or delete it" if kept.exists() else "from the start"
        say(f"avmsf edit: interrupted; run the same command again to continue {where}")
        return INTERRUPTED
    save(new, options.output)
    if asked.steering.asked:
        for ending in ("checkpoint", "preview.wav", "clap.json"):
            beside(options.output, ending).unlink(missing_ok=True)
    edits = new.origin.report[EDITS][len(old.origin.report.get(EDITS, [])) :]
    before, after = ModeLevels.of(old), ModeLevels.of(new)
    screen = console(errors=options.json)
    screen.print(_table(before, after))
    for words in remarks(edits, new):
        screen.print(f"note: {words}", soft_wrap=True)
    seconds, ringing = new.samples / new.sample_rate, _longest(after)
    if ringing > max(seconds, _longest(before)):
        screen.print(
            f"note: the longest T60 is {figure(ringing)} s and rendered sounds last {figure(seconds)} s; render and "
            f"export with --seconds {math.ceil(10 * ringing) / 10:g}",
            soft_wrap=True,
        )
    if options.change.size != 1.0:
        screen.print(f"note: positions on the edited object are {options.change.size:g} times as large", soft_wrap=True)
    softer = _level(before) - _level(after)
    if _LOUD_NOISE_DB < softer < math.inf and bool(new.residual.magnitude.any()):
        screen.print(
            f"note: the modes are {softer:.0f} dB softer and the residual noise is as loud as before; `avmsf render "
            "--no-noise` leaves it out",
            soft_wrap=True,
        )
    if options.plots is not None:
        _show(options.plots, (old, contact), (new, options.change.size * contact))
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


@dataclass(frozen=True)
class _Edit:
    """What is asked for, in the order in which it is done."""

    change: MaterialChange
    sliders: Sliders
    steering: Steering

    @classmethod
    def of(cls, options: Options) -> "_Edit":
        """Return what options ask for."""
        parts = (options.change, options.sliders, options.steering)
        kinds = (MaterialChange, Sliders, Steering)
        return cls(*(kind(**vars(part)) for kind, part in zip(kinds, parts, strict=True)))


def _edited(options: Options, asked: _Edit, field: SoundField) -> SoundField:
    named = field.bank.frequency
    needed = asked.change.asked or asked.steering.like_material is not None
    old = asked.change.infer_material(field) if needed else None
    if asked.change.asked and old is not None:
        field, old = asked.change.apply(field, old=old), asked.change.target(old)
    if asked.sliders.asked:
        field = asked.sliders.apply(field, named=named)
    if asked.steering.asked:
        field = asked.steering.apply(field, output=options.output, old=old)
    return field


def _contact(field: SoundField, at: tuple[float, float, float] | None, *, unit: Unit = "m") -> Float[Tensor, " 3"]:
    """Return the contact of the sounds: the requested one, or the loudest of some."""
    if at is not None:
        chosen = contacts_at([at], meters=METRES[unit])
        refuse_far(chosen, field, advice=", see --unit")
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
        SPECTROGRAMS: draw_sound_change(*sounds, sample_rate=old.sample_rate, title=f"an impact at {name}, edited"),
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
            figure(row["frequency_before"], 5),
            figure(row["frequency_after"], 5),
            figure(row["t60_before"]),
            figure(row["t60_after"]),
            _change(row),
        ]
        for row in (rows[place] for place in listed)
    ]
    title = (
        counted(len(rows), "mode") if len(rows) <= _LISTED else f"the {_LISTED} modes of most energy among {len(rows)}"
    )
    columns = ["before (Hz)", "after (Hz)", "T60 before (s)", "T60 after (s)", "level change (dB)"]
    return table(f"{title}, before and after", columns, cells, words=0)
