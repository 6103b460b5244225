"""Options of `avmsf edit`."""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from avmsf.cli.options.checks import OutputError, expect_device, expect_writable
from avmsf.cli.options.common import Printing, Unit, option_of
from avmsf.cli.options.paths import NEW_TENSORS, FieldFile, NewFile, PlotsFolder
from avmsf.editing.config import STABLE_AUDIO, DistillationConfig, GuidedEditConfig, check_prompt
from avmsf.errors import EditError
from avmsf.fem.material import material_named

_Pairs = tyro.conf.UseAppendAction[tuple[tuple[float, float], ...]]

MODES, SPECTROGRAMS, BEFORE, AFTER = "modes.png", "spectrograms.png", "before.wav", "after.wav"
CURVE = "clap.png"
"""What the folder of pictures holds."""
_OF_THE_MODEL = ("--model", "--negative", "--model-seconds", "--device", "--generated", "--clap")
"""Options that only a prompt needs."""


@dataclass(frozen=True)
class MaterialOptions:
    """Change material and size by the laws of linear modal analysis; the shape stays."""

    material: Annotated[str | None, tyro.conf.arg(name="to-material", metavar="NAME")] = None
    """New material: ceramic, glass, wood, plastic, iron, polycarbonate or steel."""
    old: Annotated[str | None, tyro.conf.arg(name="from", metavar="NAME")] = None
    """Present material; by default estimated from the dampings of the modes."""
    size: Annotated[float, tyro.conf.arg(name="scale")] = 1.0
    """Lengths of the new object relative to the old one."""
    young: float | None = None
    """Young's modulus of the new material in Pa, instead of the table's, as for the others below; without
    --to-material, instead of the present material's."""
    density: float | None = None
    """Density of the new material in kg/m3."""
    poisson: float | None = None
    """Poisson's ratio of the new material; only its expected effect is printed."""
    alpha: float | None = None
    """Mass-proportional Rayleigh damping of the new material in 1/s."""
    beta: float | None = None
    """Stiffness-proportional Rayleigh damping of the new material in s."""
    law: Literal["displacement", "velocity", "acceleration", "ratio-only"] = "displacement"
    """Quantity that the recordings are proportional to, which decides the level of each mode; ratio-only is the paper's
    law, which leaves mass and size out."""

    @property
    def constants(self) -> dict[str, float]:
        """The constants that are given."""
        given = {name: getattr(self, name) for name in ("young", "density", "poisson", "alpha", "beta")}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def asked(self) -> bool:
        """Whether anything changes."""
        return self.material is not None or self.size != 1.0 or bool(self.constants)


@dataclass(frozen=True)
class ModeOptions:
    """Change modes directly."""

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

    @property
    def asked(self) -> bool:
        """Whether anything changes."""
        single = self.mode_db or self.mode_pitch or self.mode_decay
        return (self.pitch, self.decay, self.brightness) != (1.0, 1.0, 0.0) or bool(single)


@dataclass(frozen=True)
class GuideOptions:
    """Optimize the modes towards a text prompt, recordings, or the sound of a material; only one of them.

    A preview of the sound is written next to the output while it runs. Repeat an interrupted command to continue it
    to the same result.
    """

    prompt: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Text that describes the sound, such as "an impact on a wooden bowl", for a text-to-audio model; needs the extra
    `text`."""
    like: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="WAV|FOLDER ...")] = ()
    """Recordings of impacts on another object to imitate: files or folders of them."""
    like_material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Material to imitate statistically, with this object's modes in it by the laws of elasticity as the target;
    --to-material follows these laws exactly."""
    model: Annotated[str, tyro.conf.arg(metavar="FOLDER|NAME")] = STABLE_AUDIO
    """Stable Audio pipeline: a folder, or its name on the hub."""
    negative: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Text that describes what to move away from."""
    model_seconds: float | None = None
    """Length that the model works at; by default all that it was trained for, and time grows in proportion."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device of the model; by default the GPU if there is one."""
    generated: Annotated[Path | None, tyro.conf.arg(metavar="FILE.wav"), NewFile((".wav",))] = None
    """Also write the sound that the model makes from the prompt without the field: the paper's baseline."""
    clap: Annotated[str | None, tyro.conf.arg(metavar="FOLDER|NAME")] = None
    """Also compute the CLAP score of the unedited field and of every preview with this network, a folder or a name on
    the hub; needs the extra `eval`."""
    parameters: Literal["hierarchical", "published", "independent", "searched"] = "hierarchical"
    """Parameters that are optimized. hierarchical: factors on all frequencies and all dampings, then single modes, with
    a penalty. published: the paper's form, a factor on all frequencies and single modes without a penalty, gains times
    f1/f2 at the end. independent: only single modes (Audio-SDS). searched: the same after a search for common
    factors."""
    distillation: Annotated[tyro.conf.OmitArgPrefixes[DistillationConfig], tyro.conf.arg(name="")] = field(
        default_factory=DistillationConfig
    )
    """Targets from the model."""
    config: Annotated[tyro.conf.OmitArgPrefixes[GuidedEditConfig], tyro.conf.arg(name="")] = field(
        default_factory=GuidedEditConfig
    )
    """How the modes are optimized."""

    @property
    def asked(self) -> bool:
        """Whether there is a guide."""
        return bool(self._guides)

    def expect_usable(self) -> None:
        """Raise before a field or a model is loaded, `SimulationError` for a material that is not known.

        And `EditError` for more than one guide, an empty prompt, and settings of a guide that is not given.
        """
        if len(self._guides) > 1:
            raise EditError(
                f"expected one of --prompt, --like and --like-material, got {' and '.join(self._guides)}; use one "
                "after the other",
                name=self._guides[0],
                value=tuple(self._guides),
            )
        if self.like_material is not None:
            material_named(self.like_material, option="--like-material")
        if not self._guides:
            given = [*(name for name in _changed(self) if name == "--parameters"), *_changed(self.config)]
            _expect_unchanged(given, "--prompt, --like or --like-material")
        if self.prompt is None:
            own = [name for name in _changed(self) if name in _OF_THE_MODEL]
            _expect_unchanged([*own, *_changed(self.distillation)], "--prompt")
            return
        check_prompt(self.prompt)
        if self.clap is not None and self.config.preview_every == 0:
            raise EditError.expected("--preview-every 1 or more with it, such as 50", 0, got="0", name="--clap")
        if self.model_seconds is not None and not 0 < self.model_seconds < math.inf:
            raise EditError.expected("more than 0, such as 3", self.model_seconds, name="--model-seconds")

    @property
    def _guides(self) -> list[str]:
        given = {"--prompt": self.prompt is not None, "--like": bool(self.like)}
        given["--like-material"] = self.like_material is not None
        return [name for name, present in given.items() if present]


@dataclass(frozen=True)
class Options(Printing):
    """Change a field's material, size, pitch or decay, or optimize it towards a text prompt or recordings.

    Material first, then modes, then the prompt, recordings or material sound. The pattern of each mode over the object
    stays, so the edited field can be rendered and used for localization like any other.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW.safetensors"), NEW_TENSORS]
    """File to write the edited field to."""
    change: Annotated[tyro.conf.OmitArgPrefixes[MaterialOptions], tyro.conf.arg(name="material")] = dataclasses.field(
        default_factory=MaterialOptions
    )
    """Material and size."""
    sliders: Annotated[tyro.conf.OmitArgPrefixes[ModeOptions], tyro.conf.arg(name="modes")] = dataclasses.field(
        default_factory=ModeOptions
    )
    """Modes."""
    steering: Annotated[tyro.conf.OmitArgPrefixes[GuideOptions], tyro.conf.arg(name="guided-edit")] = dataclasses.field(
        default_factory=GuideOptions
    )
    """Guided edits."""
    plots: PlotsFolder = None
    """Write modes.png, spectrograms.png, before.wav and after.wav to this folder; with --clap also clap.png, the score
    over the steps."""
    position: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Contact of these sounds, on the object as it was; by default where it is loudest."""
    unit: Unit = "m"
    """Unit of --position. The field itself is in meters, also where its capture is in another unit."""

    def check_inputs(self) -> None:
        """Raise the package's errors for an edit that cannot be done or written."""
        super().check_inputs()
        self.steering.expect_usable()
        expect_device(self.steering.device, raising=EditError)
        for option, name in (("--to-material", self.change.material), ("--from", self.change.old)):
            if name is not None:
                material_named(name, option=option)
        if self.change.law != MaterialOptions.law and not self.change.asked:
            raise EditError.expected("--to-material, --scale or a constant of a material with it", name="--law")
        if self.position is not None and self.plots is None:
            raise EditError("--position: expected --plots with it, got none", name="--position")
        if self.change.old is not None and not (self.change.asked or self.steering.like_material):
            raise EditError.expected("--to-material, --scale, a constant or --like-material with it", name="--from")
        if not (self.change.asked or self.sliders.asked or self.steering.asked):
            raise EditError(
                "expected an edit, got none: give --to-material, --scale or a constant of a material, --pitch, "
                "--decay, --brightness, --mode-db, --mode-pitch or --mode-decay, --prompt, --like or --like-material",
                name="options",
            )
        if self.output.exists() and self.field.exists() and self.output.samefile(self.field):
            raise OutputError(
                f"{self.output}: expected another file than the field to edit; choose another --output",
                file=self.output,
                name="--output",
            )
        if self.plots is not None:
            for name in (MODES, SPECTROGRAMS, BEFORE, AFTER, CURVE):
                expect_writable(self.plots / name)


def _changed(options: Any) -> list[str]:
    """Return which options of a dataclass are not at their defaults, as the command line calls them."""
    return [
        option_of(each.name)
        for each in dataclasses.fields(options)
        if each.default is not dataclasses.MISSING and getattr(options, each.name) != each.default
    ]


def _expect_unchanged(given: list[str], wanted: str) -> None:
    if given:
        raise EditError(
            f"{' and '.join(given)}: expected {wanted} as well, got none", name=given[0], value=tuple(given)
        )
