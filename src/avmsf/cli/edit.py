"""`avmsf edit`: a field in, the field of another material, size, pitch or sound out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options import Configured, Flag
from avmsf.cli.output import command, finish, show
from avmsf.cli.paths import FieldFile, New, OutputError, PlotsFolder, arg, expect_free
from avmsf.editing.config import STABLE_AUDIO, EditSettings
from avmsf.errors import EditError
from avmsf.fem.material import material_named

_Pairs = tyro.conf.UseAppendAction[tuple[tuple[float, float], ...]]
_MaterialName = Annotated[str | None, arg("MATERIAL")]


@dataclass(frozen=True)
class Options(Configured):
    """Change a field's material, size, pitch or decay, or optimize it towards a text prompt or recordings.

    Material and size first, by the laws of linear modal analysis, then modes, then the optimization towards --prompt,
    --like or --like-material, with a preview next to the output. The pattern of each mode over the object stays.
    """

    field: FieldFile
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW.safetensors"), New((".safetensors",))]
    """File to write the edited field to."""
    overwrite: Flag = False
    """Replace a file that is there."""
    to: _MaterialName = None
    """New material: ceramic, glass, wood, plastic, iron, polycarbonate or steel."""
    old: Annotated[str | None, arg("MATERIAL", name="from")] = None
    """Present material, by default estimated from the dampings."""
    scale: float = 1.0
    """New lengths over old ones."""
    pitch: float = 1.0
    """Factor on all frequencies."""
    decay: float = 1.0
    """Factor on all decay times."""
    brightness: float = 0.0
    """Tilt of the spectrum, dB per octave."""
    mode_db: Annotated[_Pairs, arg("HZ DB")] = ()
    """Raise the mode at this frequency; -inf mutes it."""
    mode_pitch: Annotated[_Pairs, arg("HZ FACTOR")] = ()
    """Factor on the frequency of the mode at this frequency."""
    mode_decay: Annotated[_Pairs, arg("HZ FACTOR")] = ()
    """Factor on the decay time of the mode at this frequency."""
    prompt: Annotated[str | None, arg("TEXT")] = None
    """Text that describes the sound; needs the extra `text`."""
    model: Annotated[str, arg("FOLDER|NAME")] = STABLE_AUDIO
    """Stable Audio pipeline: a folder, or its name on the hub."""
    like: Annotated[tuple[Path, ...], arg("WAV|FOLDER ...")] = ()
    """Recordings of another object to imitate."""
    like_material: _MaterialName = None
    """Material to imitate statistically, not by its laws."""
    plots: PlotsFolder = None
    """Draw and write the sounds before and after."""
    position: Annotated[tuple[float, float, float] | None, arg("X Y Z")] = None
    """Contact of these sounds, meters; by default the loudest."""

    usual = EditSettings()

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

    def _check(self) -> None:
        settings, usual, guides = self.all_settings, self.usual, self.guides
        if len(guides) > 1:
            wanted, advice = "one of --prompt, --like and --like-material", "use one after the other"
            raise EditError.expected(wanted, tuple(guides), name=guides[0], advice=advice)
        for option, name in (("--to", self.to), ("--from", self.old), ("--like-material", self.like_material)):
            if name is not None:
                material_named(name, option=option)
        law = settings.material.law != usual.material.law
        material = "--to, --scale or a constant of a material with it"
        guide = "--prompt, --like or --like-material as well"
        unused = {
            "parameters": (not guides and settings.parameters != usual.parameters, guide),
            "guide": (not guides and settings.guide != usual.guide, guide),
            "--model": (self.prompt is None and self.model != STABLE_AUDIO, "--prompt as well"),
            "prompt": (self.prompt is None and settings.prompt != usual.prompt, "--prompt as well"),
            "material.law": (law and not self.changes_material, material),
            "--from": (self.old is not None and not (self.changes_material or self.like_material), material),
            "--position": (self.position is not None and self.plots is None, "--plots with it"),
            "options": (not (self.changes_material or self.changes_modes or guides), "an edit, such as --to"),
        }
        for name, (wrong, wanted) in unused.items():
            if wrong:
                raise EditError.expected(wanted, name=name)
        if self.prompt is not None:
            settings.check_prompt(self.prompt)
            if settings.prompt.generated is not None:
                New((".wav",)).check(settings.prompt.generated)
        if self.output.exists() and self.field.exists() and self.output.samefile(self.field):
            wanted, advice = "another file than the field to edit", "choose another --output"
            raise OutputError.expected(wanted, got="the same", file=self.output, name="--output", advice=advice)
        expect_free(self.output, overwrite=self.overwrite)


def run(options: Options) -> int:
    """Edit, write, and print the result."""
    from avmsf.cli.edits import changes_table, contact_of_sounds, draw, edited, mode_changes, notes_on
    from avmsf.editing.modal_edit import EDITS, silenced
    from avmsf.field.store import load, save

    old = load(options.field)
    contact = contact_of_sounds(old, options.position)
    new = edited(options, old)
    save(new, options.output)
    for ending in ("checkpoint", "preview.wav") if options.guides else ():
        options.part(ending).unlink(missing_ok=True)
    edits = new.origin.report[EDITS][len(old.origin.report.get(EDITS, [])) :]
    modes, supporting = mode_changes(old, new)
    notes = [f"note: {each}" for each in notes_on(edits, old, new, scale=options.scale)]
    show("\n".join([changes_table(modes, old, new), *notes]))
    if options.plots is not None:
        draw(options.plots, (old, contact), (new, options.scale * contact), edits[-1])
    values = {
        "field": str(options.field),
        "output": str(options.output),
        "capture": new.origin.capture,
        "edits": edits,
        "silent_modes": int(silenced(new).sum()),
        "modes": modes,
        "supporting_poles": supporting,
    }
    step = command("avmsf render", options.output, "--position X Y Z -o impact.wav")
    return finish(f"wrote {options.output}", values, step)
