"""Options of `avmsf export`, and which of them each format uses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import tyro

from avmsf.cli.options.common import Flag, Printing, Unit, option_of
from avmsf.cli.options.paths import ContactTable, Existing, NewFile, NewFolder, OtherCapture, PositionList, ShapeFile
from avmsf.errors import ExportError
from avmsf.export.writing import SUFFIXES, Axis, Format, Precision, check_free
from avmsf.field.header import FIELD
from avmsf.modal.config import PulseShape

_CONTACTS = ("position", "contact_table", "unit")
_USED: dict[Format, tuple[str, ...]] = {
    "web": ("object", "object_unit", "capture"),
    "gltf": ("object", "object_unit", "capture", "up", *_CONTACTS),
    "faust": ("no_noise", *_CONTACTS),
    "avmsf-demo": ("object", "variant", "precision"),
    "wavs": ("forces", "contact_times", "pulse", "seconds", "no_noise", *_CONTACTS),
    "uff": ("functions", *_CONTACTS),
}
"""Options that each format uses, in addition to those that all use."""
CHOOSING = frozenset(name for name, used in _USED.items() if "position" in used)
"""Formats whose contacts can be given."""
_OF_SOME = {name for used in _USED.values() for name in used}


@dataclass(frozen=True)
class Options(Printing):
    """Write a field for other tools: web page, glTF, Faust, samplers, modal analysis.

    web: a page that plays impacts on the object, as a folder for any static host or as one .html file. gltf: a .glb
    that any viewer shows, with the draft extension KHR_audio_rigid_bodies. faust: a .dsp with controls, or a .lib
    without. avmsf-demo: the layout of the paper's own demo. wavs: sounds with a table and an SFZ instrument, for
    samplers. uff: the universal file format, for modal analysis. What a format cannot hold is printed.
    """

    field: tyro.conf.Positional[
        Annotated[
            Path,
            tyro.conf.arg(metavar="FIELD"),
            Existing("a sound field, as avmsf fit writes it", ("a sound field",)),
        ]
    ]
    """Field file, as `avmsf fit` writes it."""
    to: Format
    """Format to write."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE|FOLDER")]
    """A folder, or a file for gltf (.glb), faust (.dsp or .lib), uff (.uff) or a page in one file (.html)."""
    object: ShapeFile = None
    """Mesh, or Gaussians as a .ply, to show; by default the capture's mesh, or else the surface of the body that the
    field's gains are computed on, or else the surface made from photographs, or else the field's points."""
    object_unit: Unit = "m"
    """Unit of the coordinates of the object's mesh."""
    capture: OtherCapture = None
    """Capture folder: its mesh is shown, see --object, and a page offers its recordings next to the model's sounds."""
    contacts: int | None = None
    """Maximum number of contacts, spread over the object; by default as many as the format's tools read easily."""
    position: PositionList = ()
    """faust, gltf, uff, wavs: a contact in the object's frame, in place of contacts spread over the object; once per
    contact."""
    contact_table: ContactTable = None
    """faust, gltf, uff, wavs: table of contacts with the columns x,y,z, and nx,ny,nz for directions of impacts, such
    as a capture's impacts.csv."""
    unit: Unit = "m"
    """Unit of --position and --contact-table."""
    overwrite: Flag = False
    """Replace a file, or the folder of an earlier export, that exists."""
    forces: tuple[float, ...] = (1.0,)
    """wavs: forces of the layers, in newtons if the field knows forces, otherwise relative; written from soft to
    loud."""
    contact_times: tuple[float, ...] = ()
    """wavs: contact time of each layer's hammer in seconds; one for all, or one per force; 0 is the impact as recorded.
    By default the hardest impact is as recorded, and softer ones are longer in contact by Hertz's law."""
    seconds: float | None = None
    """wavs: length of the sounds; by default that of the training sounds."""
    pulse: PulseShape = "half-sine"
    """wavs: force over the contact time, as in `avmsf render`."""
    up: Axis = "z"
    """gltf: axis of the object's frame that points up."""
    no_noise: Flag = False
    """faust, wavs: write the modes without the residual noise."""
    functions: int = 16
    """uff: number of points whose frequency response functions are written in addition to the mode shapes."""
    variant: Annotated[str, tyro.conf.arg(metavar="NAME")] = "original"
    """avmsf-demo: name of the sound among those of one object."""
    precision: Precision = "float32"
    """avmsf-demo: number format of the gains."""

    @property
    def contacts_given(self) -> bool:
        """Whether the contacts are given, and used by the format."""
        return self.to in CHOOSING and bool(self.position or self.contact_table)

    def check_inputs(self) -> None:
        """Raise the package's errors for options that cannot be used, before anything is loaded."""
        super().check_inputs()
        given = sum((bool(self.position), self.contact_table is not None, self.contacts is not None))
        if self.contacts_given and given > 1:
            raise ExportError.expected(
                "contacts by one of --position, --contact-table and --contacts",
                given,
                name="--position" if self.position else "--contact-table",
                advice="leave out the others",
            )
        for row, place in enumerate(self.position):
            if not all(map(math.isfinite, place)):
                raise ExportError.expected("finite coordinates", list(place), row=row, name="--position")
        if self.contacts is not None and self.contacts < 1:
            raise ExportError.expected("1 or more", self.contacts, name="--contacts")
        # A web page is a file or, by a name without its suffix, a folder.
        suffixes = SUFFIXES.get(self.to, ())
        (NewFile(suffixes, or_folder=self.to == "web") if suffixes else NewFolder()).check(self.output)
        check_free(self.output, folder=self.output.suffix.lower() not in suffixes, overwrite=self.overwrite)
        FIELD.read_record(self.field)

    @classmethod
    def parse(cls, words: Sequence[str]) -> "Options":
        """Return the options that the words spell."""
        if ("--to", "sfz") in pairwise(words):
            raise ExportError.expected("--to wavs, which writes an SFZ instrument too", "sfz", name="--to")
        return super().parse(words)


def unused_options(options: Options) -> list[str]:
    """Return a sentence for each given option that the format does not use."""
    used = _USED[options.to]
    sentences = []
    for each in fields(options):
        if each.name in _OF_SOME and each.name not in used and getattr(options, each.name) != each.default:
            others = ", ".join(name for name, known in _USED.items() if each.name in known)
            sentences.append(f"{option_of(each.name)} is not used by --to {options.to}, only by {others}")
    return sentences
