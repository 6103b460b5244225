"""Options of `avmsf edit`."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from avmsf.cli.options.common import FieldFile, Printing, parse_options
from avmsf.tasks.config import STABLE_AUDIO, DistillationConfig, GuidedEditConfig

_Pairs = tyro.conf.UseAppendAction[tuple[tuple[float, float], ...]]


@dataclass(frozen=True)
class MaterialOptions:
    """Change material and size by the laws of linear modal analysis; the shape stays."""

    material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """New material: ceramic, glass, wood, plastic, iron, polycarbonate or steel."""
    old: Annotated[str | None, tyro.conf.arg(name="from", metavar="NAME")] = None
    """Present material; by default estimated from the dampings of the modes."""
    size: float = 1.0
    """Lengths of the new object relative to the old one."""
    young: float | None = None
    """Young's modulus of the new material in Pa, instead of the table's, as for the others below; without --material,
    instead of the present material's."""
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


@dataclass(frozen=True)
class GuideOptions:
    """Optimize the modes towards a text prompt, recordings, or the sound of a material; only one of them.

    A preview of the sound is written next to the output while it runs. Repeat an interrupted command to continue it
    to the same result.
    """

    prompt: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Text that describes the sound, such as "a wooden bowl is struck", for a text-to-audio model; needs the extra
    `text`."""
    like: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="WAV|FOLDER ...")] = ()
    """Recordings of impacts on another object to imitate: files or folders of them."""
    like_material: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Material to imitate statistically, with this object's modes in it by the laws of elasticity as the target;
    --material follows these laws exactly."""
    model: Annotated[str, tyro.conf.arg(metavar="FOLDER|NAME")] = STABLE_AUDIO
    """Stable Audio pipeline: a folder, or its name on the hub."""
    negative: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Text that describes what to move away from."""
    model_seconds: float | None = None
    """Length that the model works at; by default all that it was trained for, and time grows in proportion."""
    device: Annotated[str | None, tyro.conf.arg(metavar="cpu|cuda")] = None
    """Device of the model; by default the GPU if there is one."""
    generated: Annotated[Path | None, tyro.conf.arg(metavar="FILE.wav")] = None
    """Also write the sound that the model makes from the prompt without the field: the paper's baseline."""
    clap: Annotated[str | None, tyro.conf.arg(metavar="FOLDER|NAME")] = None
    """Also compute the CLAP score of the unedited field and of every preview with this network, a folder or a name on
    the hub; needs the extra `eval`."""
    parameters: Literal["hierarchical", "published", "independent", "searched"] = "hierarchical"
    """Parameters that are optimized. hierarchical: factors on all frequencies and all dampings, then single modes, with
    a penalty. published: the paper's form, a factor on all frequencies and single modes without a penalty, gains times
    f1/f2 at the end. independent: only single modes (Audio-SDS). searched: the same after a search for common
    factors."""
    distillation: tyro.conf.OmitArgPrefixes[DistillationConfig] = field(default_factory=DistillationConfig)
    """Targets from the model."""
    config: tyro.conf.OmitArgPrefixes[GuidedEditConfig] = field(default_factory=GuidedEditConfig)
    """How the modes are optimized."""


@dataclass(frozen=True)
class Options(Printing):
    """Change a field's material, size, pitch or decay, or optimize it towards a text prompt or recordings.

    Material first, then modes, then the prompt, recordings or material sound. The pattern of each mode over the object
    stays, so the edited field can be rendered and used for localization like any other.
    """

    field: tyro.conf.Positional[FieldFile]
    """Field file, as `avmsf fit` writes it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW.safetensors")]
    """File to write the edited field to."""
    change: tyro.conf.OmitArgPrefixes[MaterialOptions] = dataclasses.field(default_factory=MaterialOptions)
    """Material and size."""
    sliders: tyro.conf.OmitArgPrefixes[ModeOptions] = dataclasses.field(default_factory=ModeOptions)
    """Modes."""
    steering: tyro.conf.OmitArgPrefixes[GuideOptions] = dataclasses.field(default_factory=GuideOptions)
    """Guided edits."""
    plots: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder for modes.png, spectrograms.png, before.wav and after.wav; with --clap also clap.png, the score over the
    steps."""
    position: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Contact of these sounds in meters, on the object as it was; by default where it is loudest."""


def parse(words: Sequence[str]) -> Options:
    """Return the options that the words spell."""
    return parse_options(Options, "edit", words)
