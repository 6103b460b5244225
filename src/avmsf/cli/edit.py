"""`avmsf edit`: a field in, the field of another material, size, pitch or sound out."""

import json
import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from avmsf._utils.text import counted, format_number, read_json
from avmsf.cli import INTERRUPTED
from avmsf.cli.common import Configured, expect_device
from avmsf.cli.paths import NEW_TENSORS, FieldFile, NewFile, OutputError, PlotsFolder, expect_writable
from avmsf.cli.printing import decimals, display, doing, next_command, print_json, say, show, table
from avmsf.cli.settings import with_settings
from avmsf.editing.config import STABLE_AUDIO, DistillationConfig, GuidedEditConfig, check_prompt
from avmsf.errors import EditError
from avmsf.fem.material import Material, material_named

if TYPE_CHECKING:
    from torch import Tensor

    from avmsf.editing.guided import Guide, GuidedEditProgress
    from avmsf.evaluation.clap import Clap
    from avmsf.field.sound_field import SoundField
    from avmsf.plotting.edits import ModeLevels

_Pairs = tyro.conf.UseAppendAction[tuple[tuple[float, float], ...]]
MODES, SPECTROGRAMS, BEFORE, AFTER = "modes.png", "spectrograms.png", "before.wav", "after.wav"
CURVE = "clap.png"
"""What the folder of pictures holds."""
CLAP = "clap"
"""The key of the scores in the last edit of a field's report."""
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


@dataclass(frozen=True)
class MaterialSettings:
    """Constants of the new material in place of the table's, or without --to of the present material's."""

    young: float | None = None
    """Young's modulus, Pa."""
    density: float | None = None
    """Density, kg/m3."""
    poisson: float | None = None
    """Poisson's ratio; only its expected effect is printed."""
    alpha: float | None = None
    """Mass-proportional Rayleigh damping, 1/s."""
    beta: float | None = None
    """Stiffness-proportional Rayleigh damping, s."""
    law: Literal["displacement", "velocity", "acceleration", "ratio-only"] = "displacement"
    """Quantity that the recordings are proportional to, which decides the level of each mode; ratio-only is the paper's
    law, which leaves mass and size out."""

    @property
    def constants(self) -> dict[str, float]:
        """The constants that are given."""
        given = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "law"}
        return {name: value for name, value in given.items() if value is not None}


@dataclass(frozen=True)
class PromptSettings:
    """Targets from a text-to-audio model."""

    negative: str | None = None
    """Text that describes what to move away from."""
    model_seconds: float | None = None
    """Length that the model works at; by default all that it was trained for, and time grows in proportion."""
    device: str | None = None
    """Device of the model, cpu or cuda; by default the GPU if there is one."""
    generated: Path | None = None
    """Also write the sound that the model makes from the prompt without the field to this wav file: the paper's
    baseline."""
    clap: str | None = None
    """Also compute the CLAP score of the unedited field and of every preview with this network, a folder or a name on
    the hub; needs the extra `eval`."""
    distillation: DistillationConfig = field(default_factory=DistillationConfig)
    """Targets from the model."""


@dataclass(frozen=True)
class EditSettings:
    """Settings of an edit."""

    material: MaterialSettings = field(default_factory=MaterialSettings)
    """The new material."""
    prompt: PromptSettings = field(default_factory=PromptSettings)
    """Targets from a text-to-audio model."""
    parameters: Literal["hierarchical", "published", "independent", "searched"] = "hierarchical"
    """Parameters that are optimized. hierarchical: factors on all frequencies and all dampings, then single modes, with
    a penalty. published: the paper's form, a factor on all frequencies and single modes without a penalty, gains times
    f1/f2 at the end. independent: only single modes (Audio-SDS). searched: the same after a search for common
    factors."""
    guide: GuidedEditConfig = field(default_factory=GuidedEditConfig)
    """How the modes are optimized."""


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
        check_prompt(self.prompt)
        if prompted.clap is not None and settings.guide.preview_every == 0:
            raise EditError.expected("guide.preview_every of 1 or more with it, such as 50", 0, name="prompt.clap")
        if prompted.model_seconds is not None and not 0 < prompted.model_seconds < math.inf:
            raise EditError.expected("more than 0, such as 3", prompted.model_seconds, name="prompt.model_seconds")
        if prompted.generated is not None:
            NewFile((".wav",)).check(prompted.generated)


def run(options: Options) -> int:
    """Edit, write, and print the result; return 130 where Ctrl-C stopped it."""
    from avmsf.editing.modal_edit import EDITS, silenced
    from avmsf.field.store import load, save
    from avmsf.plotting.edits import ModeLevels

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
    for ending in ("checkpoint", "preview.wav", "clap.json") if options.guides else ():
        _next_to(options.output, ending).unlink(missing_ok=True)
    edits = new.origin.report[EDITS][len(old.origin.report.get(EDITS, [])) :]
    before, after = ModeLevels.of(old), ModeLevels.of(new)
    rows = _rows(before, after)
    notes = _notes(options, edits, new, before, after)
    show("\n".join([_table(rows, before, after), *(f"note: {each}" for each in notes)]), json=options.json)
    if options.plots is not None:
        _draw(options.plots, (old, contact), (new, options.scale * contact), edits[-1])
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


def _notes(
    options: Options, edits: list[dict[str, Any]], new: "SoundField", before: "ModeLevels", after: "ModeLevels"
) -> list[str]:
    """Return what a user of an edited field should know."""
    from avmsf.editing.modal_edit import remarks

    notes = [*remarks(edits, new)]
    seconds, ringing = new.samples / new.sample_rate, _longest(after)
    if ringing > max(seconds, _longest(before)):
        notes.append(
            f"the longest T60 is {format_number(ringing)} s and rendered sounds last {format_number(seconds)} s; "
            f"render and export with --seconds {math.ceil(10 * ringing) / 10:g}"
        )
    if options.scale != 1.0:
        notes.append(f"positions on the edited object are {options.scale:g} times as large")
    softer = _level(before) - _level(after)
    if _LOUD_NOISE_DB < softer < math.inf and bool(new.residual.magnitude.any()):
        notes.append(
            f"the modes are {softer:.0f} dB softer and the residual noise is as loud as before; `avmsf render "
            "--no-noise` leaves it out"
        )
    return notes


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
    return _guided(options, settings, field, target or old) if options.guides else field


def _adjustments(options: Options, field: "SoundField") -> dict[str, Any]:
    """Return what `edit` does with each mode by hand; modes are called by their frequencies, Hz."""
    import torch

    named = field.bank.frequency
    levels = torch.zeros(len(named), dtype=torch.float64)
    pitch, decay = torch.full_like(levels, options.pitch), torch.full_like(levels, options.decay)
    for frequency, level in options.mode_db:
        levels[_called(frequency, named, "--mode-db")] += level
    for frequency, factor in options.mode_pitch:
        pitch[_called(frequency, named, "--mode-pitch")] *= factor
    for frequency, factor in options.mode_decay:
        decay[_called(frequency, named, "--mode-decay")] *= factor
    return {"pitch": pitch, "decay": decay, "brightness_db": options.brightness, "gains_db": levels}


def _called(frequency: float, named: "Tensor", option: str) -> int:
    """Return the index of the mode at a frequency. Raises EditError where there is none."""
    row = int((named - frequency).abs().argmin())
    nearest = float(named[row])
    if not abs(nearest - frequency) <= _NEAR * nearest:
        advice = f"the nearest is at {nearest:.5g} Hz (`avmsf info` lists them)"
        got = f"{frequency:g} Hz"
        raise EditError.expected("the frequency of a mode", frequency, got=got, name=option, advice=advice)
    return row


def _guided(options: Options, settings: EditSettings, field: "SoundField", old: Material | None) -> "SoundField":
    """Return the field edited towards a prompt, recordings, or the sound of a material.

    State and preview are written next to the output, so that the same command continues to the same result. `old` is
    the field's material, needed only for `like_material`.
    """
    from avmsf.cli.writing import Level, write_sound
    from avmsf.editing.guided import PARAMETERIZATIONS, edit_towards
    from avmsf.editing.modal_edit import EDITS
    from avmsf.evaluation.clap import Clap

    preview, checkpoint = _next_to(options.output, "preview.wav"), _next_to(options.output, "checkpoint")
    curve: ClapCurve | None = None
    if settings.prompt.clap is not None and options.prompt is not None:
        clap, kept = Clap.load(settings.prompt.clap), _next_to(options.output, "clap.json")
        curve = ClapCurve(clap, options.prompt, field, kept, resumed=checkpoint.exists())
    # After CLAP: a wrong name of its network is refused before the large model is loaded.
    guide = _guide(options, settings, field, old)

    def progress(reached: "GuidedEditProgress") -> None:
        if curve is not None:
            curve.add(reached)
        message = f"loss {format_number(reached.loss)}, pitch x {format_number(reached.pitch, 4)}"
        if reached.preview is not None:
            factor = Level("peak", -1.0).factor(reached.preview[None])
            write_sound(preview, factor * reached.preview, sample_rate=field.sample_rate, coding="float32")
            say(f"edit: step {reached.step} of {reached.steps}, {message}; preview in {preview}")
        display.step("edit", reached.step, reached.steps, message)

    edited = edit_towards(
        field, guide, config=settings.guide, parameters=PARAMETERIZATIONS[settings.parameters], progress=progress,
        checkpoint=checkpoint,
    )  # fmt: skip
    if curve is None:
        return edited
    *others, last = edited.origin.report[EDITS]
    report = {**edited.origin.report, EDITS: [*others, {**last, CLAP: curve.record()}]}
    return replace(edited, origin=replace(edited.origin, report=report))


def _guide(options: Options, settings: EditSettings, field: "SoundField", old: Material | None) -> "Guide":
    from avmsf.cli.writing import write_sound
    from avmsf.editing.distillation import DecoderDistillation
    from avmsf.editing.reference import Reference
    from avmsf.editing.stable_audio import StableAudio

    prompted, seed = settings.prompt, settings.guide.seed
    if options.like_material is not None:
        assert old is not None
        return Reference.of_material(field, old, material_named(options.like_material), seed=seed)
    if options.prompt is None:
        return Reference.read(options.like, sample_rate=field.sample_rate)
    doing(f"loading {options.model}")
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

    def __init__(self, clap: "Clap", prompt: str, field: "SoundField", kept: Path, *, resumed: bool) -> None:
        """Start a curve, or with `resumed` continue that of the file `kept`.

        Raises EditError for a file that is damaged or has scores of another network.
        """
        self.clap, self.prompt, self.field, self.kept = clap, prompt, field, kept
        self.scores = _read_scores(kept, clap) if resumed and kept.is_file() else {}

    def add(self, progress: "GuidedEditProgress") -> None:
        """Score a preview, and the unedited field before the first one. Silent sounds have no score."""
        if progress.preview is None or progress.place is None:
            return
        if not self.scores:
            self._score(0, self.field.render(progress.place[None])[0])
        self._score(progress.step, progress.preview)
        from avmsf._utils.files import write_whole

        text = json.dumps({"digest": self.clap.digest, "scores": list(self.scores.items())})
        write_whole(self.kept, text, raising=EditError)

    def record(self) -> dict[str, Any]:
        """Return the steps and scores as plain values."""
        return {"model": self.clap.name, "steps": [*self.scores], "scores": [*self.scores.values()]}

    def _score(self, step: int, sound: "Tensor") -> None:
        if bool(sound.any()):
            self.scores[step] = float(self.clap.score(sound[None], [self.prompt], sample_rate=self.field.sample_rate))


def _read_scores(path: Path, clap: "Clap") -> dict[int, float]:
    try:
        read = read_json(path)
        scores = {int(step): float(score) for step, score in read["scores"]}
        digest = read["digest"]
    except (OSError, ValueError, TypeError, KeyError) as error:
        advice = "delete the file to continue"
        raise EditError.expected("CLAP scores", got=str(error), file=path, advice=advice) from error
    if digest != clap.digest:
        got, advice = "those of another network", "give that network"
        raise EditError.expected(f"scores of {clap.name}", digest, got=got, file=path, name="digest", advice=advice)
    return scores


def _contact(field: "SoundField", at: tuple[float, float, float] | None) -> "Tensor":
    """Return the contact of the sounds: the requested one, or the loudest of some."""
    from avmsf.cli.contacts import contacts_at, refuse_far

    if at is not None:
        chosen = contacts_at([at], meters=1.0)
        refuse_far(chosen, field, advice=", in meters")
        return chosen.places[0].double()
    points = field.gain_field.points
    some = points[:: max(1, len(points) // _CANDIDATES)]
    energy = (field.known(some).power * field.audible / field.bank.damping).sum(1)
    return some[int(energy.argmax())].double()


def _draw(
    folder: Path, before: "tuple[SoundField, Tensor]", after: "tuple[SoundField, Tensor]", last: dict[str, Any]
) -> None:
    """Write pictures and sounds of both fields at a place each, by one factor, and the CLAP scores of the last edit."""
    import torch

    from avmsf.cli.writing import Level, write_sound
    from avmsf.plotting.edits import ModeLevels, draw_clap_curves, draw_edit
    from avmsf.plotting.pictures import save_picture
    from avmsf.plotting.spectrograms import draw_spectrograms

    old, new = before[0], after[0]
    name, rate = old.origin.capture or "field", old.sample_rate
    sounds = torch.cat([field.render(place[None]) for field, place in (before, after)])
    pictures = {
        MODES: draw_edit(ModeLevels.of(old), ModeLevels.of(new), sample_rate=rate, title=f"modes of {name}, edited"),
        SPECTROGRAMS: draw_spectrograms(
            *sounds[:, None],
            sample_rate=rate,
            names=[""],
            title=f"an impact at {name}, edited",
            columns=("before", "after"),
            shared_scale=False,
        ),
    }
    if CLAP in last:
        curve = list(zip(last[CLAP]["steps"], last[CLAP]["scores"], strict=True))
        pictures[CURVE] = draw_clap_curves({last["parameters"]: [curve]}, title=f"CLAP score: {last['prompt']}")
    for each, picture in pictures.items():
        save_picture(picture, folder / each)
    factor = Level("peak", -1.0).factor(sounds)
    for each, sound in zip((BEFORE, AFTER), sounds, strict=True):
        write_sound(folder / each, factor * sound, sample_rate=rate, coding="float32")
    say(f"wrote {', '.join((*pictures, BEFORE, AFTER))} in {folder}")


def _rows(before: "ModeLevels", after: "ModeLevels") -> list[dict[str, Any]]:
    """Return what became of each mode, in the field's order."""
    change = 20.0 * (after.size / before.size).log10()
    columns = (before.frequency, after.frequency, before.t60, after.t60, change)
    names = ("frequency_before", "frequency_after", "t60_before", "t60_after", "level_change_db")
    return [
        {**dict(zip(names, row, strict=True)), "silent": size == 0.0}
        for *row, size in zip(*(column.tolist() for column in columns), after.size.tolist(), strict=True)
    ]


def _longest(modes: "ModeLevels") -> float:
    """Return the longest T60 of the modes that sound, s; zero without one."""
    return max([0.0, *modes.t60[modes.size > 0].tolist()])


def _level(modes: "ModeLevels") -> float:
    """Return the level of all modes together, dB; -inf without one that sounds."""
    return float(20.0 * modes.size.norm().log10())


def _change(row: dict[str, Any]) -> str:
    if row["silent"]:
        return "silent"
    return decimals(row["level_change_db"], 1) if math.isfinite(row["level_change_db"]) else "back"


def _table(rows: list[dict[str, Any]], before: "ModeLevels", after: "ModeLevels") -> str:
    energy = (before.size.square() * before.t60).maximum(after.size.square() * after.t60)
    listed = energy.argsort(descending=True)[:_LISTED].sort().values.tolist()
    cells = []
    for row in (rows[place] for place in listed):
        frequencies = [format_number(row[f"frequency_{when}"], 5) for when in ("before", "after")]
        cells.append([*frequencies, *(format_number(row[f"t60_{when}"]) for when in ("before", "after")), _change(row)])
    title = (
        counted(len(rows), "mode") if len(rows) <= _LISTED else f"the {_LISTED} modes of most energy among {len(rows)}"
    )
    columns = ["before (Hz)", "after (Hz)", "T60 before (s)", "T60 after (s)", "level change (dB)"]
    return table(f"{title}, before and after", columns, cells, words=0)
