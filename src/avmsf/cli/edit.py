"""`avmsf edit`: a field in, the field of another material, size, pitch or sound out."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from avmsf.cli import INTERRUPTED
from avmsf.cli.common import Configured, expect_device
from avmsf.cli.paths import NEW_TENSORS, FieldFile, NewFile, OutputError, PlotsFolder, expect_writable
from avmsf.cli.printing import next_command, print_json, say, show
from avmsf.cli.settings import with_settings
from avmsf.editing.config import STABLE_AUDIO, EditSettings, MaterialSettings
from avmsf.errors import EditError
from avmsf.fem.material import Material, material_named

if TYPE_CHECKING:
    from avmsf.field.sound_field import SoundField

_Pairs = tyro.conf.UseAppendAction[tuple[tuple[float, float], ...]]
MODES, SPECTROGRAMS, BEFORE, AFTER = "modes.png", "spectrograms.png", "before.wav", "after.wav"
CURVE = "clap.png"
"""What the folder of pictures holds."""


@dataclass(frozen=True)
class Options(Configured):
    """Change a field's material, size, pitch or decay, or optimize it towards a text prompt or recordings.

    Material and size first, by the laws of linear modal analysis; then the modes; then the optimization towards one of
    a prompt, recordings and the sound of a material, of which a preview is written next to the output while it runs.
    Repeat an interrupted command to continue it to the same result. The pattern of each mode over the object stays, so
    the edited field can be rendered and used for localization like any other.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW.safetensors"), NEW_TENSORS]
    """File to write the edited field to."""
    to: Annotated[str | None, tyro.conf.arg(metavar="MATERIAL")] = None
    """New material: ceramic, glass, wood, plastic, iron, polycarbonate or steel."""
    old: Annotated[str | None, tyro.conf.arg(name="from", metavar="MATERIAL")] = None
    """Present material, by default estimated from the dampings."""
    scale: float = 1.0
    """Lengths of the new object relative to the old one."""
    pitch: float = 1.0
    """Factor on all frequencies."""
    decay: float = 1.0
    """Factor on all decay times."""
    brightness: float = 0.0
    """Tilt of the spectrum about its middle, dB per octave."""
    mode_db: Annotated[_Pairs, tyro.conf.arg(metavar="HZ DB")] = ()
    """Raise the mode at this frequency of the field as it was by so many dB; -inf mutes it."""
    mode_pitch: Annotated[_Pairs, tyro.conf.arg(metavar="HZ FACTOR")] = ()
    """Factor on the frequency of the mode at this frequency, in addition to --pitch."""
    mode_decay: Annotated[_Pairs, tyro.conf.arg(metavar="HZ FACTOR")] = ()
    """Factor on its decay time, in addition to --decay."""
    prompt: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Text that describes the sound, for a text-to-audio model; needs the extra `text`."""
    model: Annotated[str, tyro.conf.arg(metavar="FOLDER|NAME")] = STABLE_AUDIO
    """Stable Audio pipeline: a folder, or its name on the hub."""
    like: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="WAV|FOLDER ...")] = ()
    """Recordings of another object to imitate: files or folders."""
    like_material: Annotated[str | None, tyro.conf.arg(metavar="MATERIAL")] = None
    """Material to imitate statistically; --to follows the laws of elasticity exactly."""
    plots: PlotsFolder = None
    """Write modes.png, spectrograms.png, before.wav, after.wav, with prompt.clap also clap.png, to this folder."""
    position: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Contact of these sounds on the object as it was, meters; by default where it is loudest."""

    usual = EditSettings()

    @cached_property
    def all_settings(self) -> EditSettings:
        """The settings."""
        return with_settings(self.usual, self.set, self.config)

    @property
    def changes_material(self) -> bool:
        """Whether the material or the size changes."""
        return self.to is not None or self.scale != 1.0 or bool(self.all_settings.material.constants)

    @property
    def changes_modes(self) -> bool:
        """Whether modes are changed directly."""
        single = self.mode_db or self.mode_pitch or self.mode_decay
        return (self.pitch, self.decay, self.brightness) != (1.0, 1.0, 0.0) or bool(single)

    @property
    def guides(self) -> list[str]:
        """The options that say what the modes are optimized towards."""
        given = {"--prompt": self.prompt is not None, "--like": bool(self.like)}
        given["--like-material"] = self.like_material is not None
        return [name for name, present in given.items() if present]

    def part(self, ending: str) -> Path:
        """Return the path of a part of an unfinished edit: next to its later file."""
        return self.output.with_name(f"{self.output.name}.{ending}")

    def check_inputs(self) -> None:
        """Raise the package's errors for an edit that cannot be done or written, before anything is loaded."""
        super().check_inputs()
        settings = self.all_settings
        self._check_guide(settings)
        for option, name in (("--to", self.to), ("--from", self.old), ("--like-material", self.like_material)):
            if name is not None:
                material_named(name, option=option)
        wanted = "--to, --scale or a constant of a material with it"
        if settings.material.law != MaterialSettings.law and not self.changes_material:
            raise EditError.expected(wanted, name="material.law")
        if self.old is not None and not (self.changes_material or self.like_material):
            raise EditError.expected(f"{wanted}, or --like-material", name="--from")
        if self.position is not None and self.plots is None:
            raise EditError.expected("--plots with it", name="--position")
        if not (self.changes_material or self.changes_modes or self.guides):
            wanted = "an edit: --to, --scale, --pitch, --decay, --brightness, --mode-db, --mode-pitch, --mode-decay"
            raise EditError.expected(
                f"{wanted}, --prompt, --like, --like-material or --set material.young=PASCALS", name="options"
            )
        if self.output.exists() and self.field.exists() and self.output.samefile(self.field):
            wanted, advice = "another file than the field to edit", "choose another --output"
            raise OutputError.expected(wanted, got="the same", file=self.output, name="--output", advice=advice)
        for name in (MODES, SPECTROGRAMS, BEFORE, AFTER, CURVE):
            expect_writable(None if self.plots is None else self.plots / name)

    def _check_guide(self, settings: EditSettings) -> None:
        """Raise EditError for more than one guide, an empty prompt, and settings of a guide that is not given."""
        if len(self.guides) > 1:
            wanted, advice = "one of --prompt, --like and --like-material", "use one after the other"
            raise EditError.expected(wanted, tuple(self.guides), name=self.guides[0], advice=advice)
        usual, prompted = self.usual, settings.prompt
        for name in ("parameters", "guide") if not self.guides else ():
            if getattr(settings, name) != getattr(usual, name):
                raise EditError.expected("--prompt, --like or --like-material as well", name=name)
        expect_device(prompted.device, raising=EditError)
        if self.prompt is None:
            if prompted != usual.prompt or self.model != STABLE_AUDIO:
                raise EditError.expected("--prompt as well", name="prompt" if self.model == STABLE_AUDIO else "--model")
            return
        settings.check_prompt(self.prompt)
        if prompted.generated is not None:
            NewFile((".wav",)).check(prompted.generated)


def run(options: Options) -> int:
    """Edit, write, and print the result; return 130 where Ctrl-C stopped it."""
    from avmsf.cli.edit_report import changes_table, contact_of_sounds, draw, mode_changes, notes_on
    from avmsf.editing.modal_edit import EDITS, silenced
    from avmsf.field.store import load, save
    from avmsf.plotting.edits import ModeLevels

    old = load(options.field)
    contact = contact_of_sounds(old, options.position)
    try:
        new = _edited(options, old)
    except KeyboardInterrupt:
        kept = options.part("checkpoint")
        where = f"from {kept}, or delete it" if kept.exists() else "from the start"
        say(f"avmsf edit: interrupted; run the same command again to continue {where}", always=True)
        return INTERRUPTED
    save(new, options.output)
    for ending in ("checkpoint", "preview.wav", "clap.json") if options.guides else ():
        options.part(ending).unlink(missing_ok=True)
    edits = new.origin.report[EDITS][len(old.origin.report.get(EDITS, [])) :]
    before, after = ModeLevels.of(old), ModeLevels.of(new)
    rows = mode_changes(before, after)
    notes = notes_on(options, edits, new, before, after)
    show("\n".join([changes_table(rows, before, after), *(f"note: {each}" for each in notes)]), json=options.json)
    if options.plots is not None:
        draw(options.plots, (old, contact), (new, options.scale * contact), edits[-1])
    show(f"wrote {options.output}", json=options.json)
    if options.json:
        print_json(
            {
                "field": str(options.field),
                "output": str(options.output),
                "capture": new.origin.capture,
                "edits": edits,
                "silent_modes": int(silenced(new).sum()),
                "modes": rows,
            }
        )
    next_command("avmsf render", options.output, "--position X Y Z -o impact.wav")
    return 0


def _edited(options: Options, field: "SoundField") -> "SoundField":
    """Return the edited field: material, size and modes by `edit`, then the guided edit."""
    from avmsf.editing.material import LAWS, edit, infer_material

    settings = options.all_settings
    old: Material | None = None
    target: Material | None = None
    if options.changes_material or options.like_material is not None:
        new = None if options.to is None else material_named(options.to)
        if options.old is not None:
            old = material_named(options.old)
        else:
            old, words = infer_material(field, option="--from", new=new)
            say(words)
    if options.changes_material and old is not None:
        target = old if options.to is None else material_named(options.to)
        if constants := settings.material.constants:
            target = replace(target, name=f"{target.name} with {', '.join(constants)} changed", **constants)
    if options.changes_material or options.changes_modes:
        adjusted = _adjustments(options, field) if options.changes_modes else dict[str, Any]()
        law = LAWS[settings.material.law]
        field = edit(field, material=target, old_material=old, size=options.scale, law=law, **adjusted)
    if not options.guides:
        return field
    from avmsf.cli.guided_edit import edit_by_guide

    return edit_by_guide(options, field, target or old)


def _adjustments(options: Options, field: "SoundField") -> dict[str, Any]:
    """Return what `edit` does with each mode by hand; modes are called by their frequencies, Hz."""
    import torch

    from avmsf.editing.modal_edit import mode_at

    bank = field.bank
    levels = torch.zeros(len(bank), dtype=torch.float64)
    pitch, decay = torch.full_like(levels, options.pitch), torch.full_like(levels, options.decay)
    for frequency, level in options.mode_db:
        levels[mode_at(bank, frequency, option="--mode-db")] += level
    for frequency, factor in options.mode_pitch:
        pitch[mode_at(bank, frequency, option="--mode-pitch")] *= factor
    for frequency, factor in options.mode_decay:
        decay[mode_at(bank, frequency, option="--mode-decay")] *= factor
    return {"pitch": pitch, "decay": decay, "brightness_db": options.brightness, "gains_db": levels}
