"""What `avmsf export` can be told, and what of it says nothing to a format."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from avmsf.errors import ExportError
from avmsf.export.faust import SUFFIXES as FAUST_SUFFIXES
from avmsf.export.formats import MOST_POINTS, Precision
from avmsf.export.gltf import SUFFIXES as GLTF_SUFFIXES
from avmsf.export.universal import SUFFIXES as UNIVERSAL_SUFFIXES
from avmsf.export.webpage import SUFFIXES as PAGE_SUFFIXES
from avmsf.export.written import expect_ending
from avmsf.modal.config import PulseShape

Format = Literal["web", "gltf", "faust", "avmsf-demo", "wavs", "uff"]
POINTS = {"web": MOST_POINTS, "gltf": 2000, "faust": 64, "avmsf-demo": 10_000, "wavs": 16, "uff": 1000}
"""Points that are written unless others are asked for: as many as the format's tools take without effort."""
_FILES: dict[Format, tuple[str, ...]] = {"gltf": GLTF_SUFFIXES, "faust": FAUST_SUFFIXES, "uff": UNIVERSAL_SUFFIXES}
"""Formats that are one file, and what its name may end in."""
_FOLDERS: dict[Format, str] = {
    "web": "a page as a folder, or as one file whose name ends in .html",
    "avmsf-demo": "a folder in the layout of the paper's demo",
    "wavs": "a folder with a wav file for each blow, a table and an SFZ instrument",
}
"""Formats that are folders, and what is written."""
_ENDINGS = frozenset(
    (
        *(".aif", ".aiff", ".flac", ".mp3", ".ogg", ".wav"),
        *(".csv", ".json", ".sfz", ".txt", ".safetensors"),
        *(".obj", ".ply", ".stl"),
        *(".gz", ".tar", ".zip"),
        *(*GLTF_SUFFIXES, *FAUST_SUFFIXES, *UNIVERSAL_SUFFIXES, *PAGE_SUFFIXES),
    )
)
"""Endings by which a name is that of a file: a folder's may have a dot too, as in bowl-1.2 or name.github.io."""
_HEEDED: dict[Format, tuple[str, ...]] = {
    "web": ("object", "object_unit", "capture"),
    "gltf": ("object", "object_unit", "capture"),
    "faust": ("no_noise",),
    "avmsf-demo": ("object", "variant", "precision"),
    "wavs": ("forces", "contact_times", "pulse", "seconds"),
    "uff": ("functions",),
}
"""The settings that each format heeds, beside those that all do."""
_OF_SOME = {"rate"}.union(*_HEEDED.values())


@dataclass(frozen=True)
class Options:
    """Write a field for other tools: web page, glTF, Faust, samplers, modal analysis.

    web: a page on which it is struck, a folder for any static host or one .html file. gltf: a .glb that any viewer
    shows, with the draft extension KHR_audio_rigid_bodies. faust: a .dsp with controls, or a .lib without. avmsf-demo:
    the layout of the paper's own demo. wavs: a grid of blows with a table and an SFZ instrument, for samplers. uff: the
    universal file format, for modal analysis. What a format cannot hold is said.
    """

    field: tyro.conf.Positional[Path]
    """Field file, as `avmsf fit` writes it; or a folder in the layout of the paper's demo."""
    to: Format
    """What is written."""
    output: Path
    """Where: a folder, or a file for gltf (.glb), faust (.dsp or .lib), uff (.uff), a page in one file (.html)."""
    object: Path | None = None
    """What is shown: a mesh, or Gaussians as a .ply. Without it the capture's surface, or else the field's points."""
    object_unit: Literal["m", "cm", "mm", "in", "ft"] = "m"
    """What the coordinates of the object's mesh count."""
    capture: Path | None = None
    """Capture folder: its surface is shown, and on a page its recorded strikes stand beside the model's."""
    points: int | None = None
    """Most contacts that are written, spread over the object; as the format's tools like it where it is not given."""
    force: bool = False
    """Write over files that no export wrote. Files of other names are left alone."""
    forces: tuple[float, ...] = (1.0,)
    """wavs: forces of the layers, from soft to hard, in newtons where the field knows forces, else relative."""
    contact_times: tuple[float, ...] = (0.0,)
    """wavs: how long the hammer of each layer touches, seconds; one for all, or as many as forces."""
    seconds: float | None = None
    """wavs: length of the sounds; that of the training sounds where it is not given."""
    pulse: PulseShape = "half-sine"
    """wavs: how the force rises and falls over that time, as in `avmsf render`."""
    no_noise: bool = False
    """faust: the modes alone."""
    functions: int = 16
    """uff: points whose frequency response functions are written beside the mode shapes."""
    variant: str | None = None
    """avmsf-demo: name of the sound among those of one object, to write ("original") or to read."""
    precision: Precision = "float32"
    """avmsf-demo: how gains are written."""
    rate: float | None = None
    """Samples per second, Hz, of a field in the demo's layout, which does not say."""


def refuse_idle(options: Options) -> None:
    """Raise `ExportError` for a setting that says nothing to this format."""
    heeded = _HEEDED[options.to] + (("variant", "rate") if options.field.is_dir() else ())
    for each in fields(options):
        if each.name in _OF_SOME and each.name not in heeded and getattr(options, each.name) != each.default:
            others = ", ".join(name for name, known in _HEEDED.items() if each.name in known) or "the demo's folders"
            raise ExportError(
                f"--{each.name.replace('_', '-')} says nothing to --to {options.to}, only to {others}: leave it out"
            )


def refuse_name(options: Options) -> None:
    """Raise `ExportError` for a file's name without an ending of this format, or with one where a folder is written."""
    output, suffix = options.output, options.output.suffix.lower()
    if options.to in _FILES:
        expect_ending(output, _FILES[options.to])
    elif suffix in _ENDINGS and not output.is_dir() and not (options.to == "web" and suffix in PAGE_SUFFIXES):
        raise ExportError(
            f"{output}: expected a folder's name, for --to {options.to} writes {_FOLDERS[options.to]}, found one that "
            f"ends in {output.suffix}: say --output {output.with_suffix('')}"
        )
