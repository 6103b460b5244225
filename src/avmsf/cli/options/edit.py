"""Options of `avmsf edit`."""

import math
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.cli.options.checks import OutputError, expect_device, expect_writable
from avmsf.cli.options.common import Configured
from avmsf.cli.options.paths import NEW_TENSORS, FieldFile, NewFile, PlotsFolder
from avmsf.cli.options.settings import with_settings
from avmsf.editing.config import STABLE_AUDIO, DistillationConfig, GuidedEditConfig, check_prompt
from avmsf.errors import EditError
from avmsf.fem.material import material_named

_Pairs = tyro.conf.UseAppendAction[tuple[tuple[float, float], ...]]

MODES, SPECTROGRAMS, BEFORE, AFTER = "modes.png", "spectrograms.png", "before.wav", "after.wav"
CURVE = "clap.png"
"""What the folder of pictures holds."""


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
    """Present material; by default estimated from the dampings of the modes."""
    scale: float = 1.0
    """Lengths of the new object relative to the old one."""
    pitch: float = 1.0
    """Factor on all frequencies."""
    decay: float = 1.0
    """Factor on all decay times."""
    brightness: float = 0.0
    """Tilt of the spectrum about its middle in dB per octave."""
    mode_db: Annotated[_Pairs, tyro.conf.arg(metavar="HZ DB")] = ()
    """Raise the mode at this frequency, as the field has it before the edit, by so many dB; -inf mutes it."""
    mode_pitch: Annotated[_Pairs, tyro.conf.arg(metavar="HZ FACTOR")] = ()
    """Factor on the frequency of the mode at this frequency, in addition to --pitch."""
    mode_decay: Annotated[_Pairs, tyro.conf.arg(metavar="HZ FACTOR")] = ()
    """Factor on the decay time of the mode at this frequency, in addition to --decay."""
    prompt: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Text that describes the sound, such as "an impact on a wooden bowl", for a text-to-audio model; needs the extra
    `text`."""
    model: Annotated[str, tyro.conf.arg(metavar="FOLDER|NAME")] = STABLE_AUDIO
    """Stable Audio pipeline: a folder, or its name on the hub."""
    like: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="WAV|FOLDER ...")] = ()
    """Recordings of impacts on another object to imitate: files or folders of them."""
    like_material: Annotated[str | None, tyro.conf.arg(metavar="MATERIAL")] = None
    """Material to imitate statistically, with this object's modes in it by the laws of elasticity as the target; --to
    follows these laws exactly."""
    plots: PlotsFolder = None
    """Write modes.png, spectrograms.png, before.wav and after.wav to this folder; with prompt.clap also clap.png, the
    score over the steps."""
    position: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Contact of these sounds, meters, on the object as it was; by default where it is loudest."""

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
        if settings.material.law != MaterialSettings.law and not self.changes_material:
            raise EditError.expected("--to, --scale or a constant of a material with it", name="material.law")
        if self.position is not None and self.plots is None:
            raise EditError.expected("--plots with it", name="--position")
        if self.old is not None and not (self.changes_material or self.like_material):
            raise EditError.expected(
                "--to, --scale, a constant of a material or --like-material with it", name="--from"
            )
        if not (self.changes_material or self.changes_modes or self.guides):
            ways = (
                "--to, --scale, --pitch, --decay, --brightness, --mode-db, --mode-pitch, --mode-decay, --prompt, --like"
            )
            advice = f"give {ways} or --like-material, or --set material.young=PASCALS"
            raise EditError.expected("an edit", name="options", advice=advice)
        if self.output.exists() and self.field.exists() and self.output.samefile(self.field):
            wanted, got = "another file than the field to edit", "the same"
            raise OutputError.expected(wanted, got=got, file=self.output, name="--output", advice="choose another")
        if self.plots is not None:
            for name in (MODES, SPECTROGRAMS, BEFORE, AFTER, CURVE):
                expect_writable(self.plots / name)

    def _check_guide(self, settings: EditSettings) -> None:
        """Raise EditError for more than one guide, an empty prompt, and settings of a guide that is not given."""
        if len(self.guides) > 1:
            wanted, advice = "one of --prompt, --like and --like-material", "use one after the other"
            got = " and ".join(self.guides)
            raise EditError.expected(wanted, tuple(self.guides), got=got, name=self.guides[0], advice=advice)
        usual, prompted = self.usual, settings.prompt
        if not self.guides:
            for name in ("parameters", "guide"):
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
