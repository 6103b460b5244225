"""What the paths of options have to be: marks on their types, checked before anything that computes is loaded.

An input exists and is no file of another kind; an output can be written, and its ending is that of its format.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from avmsf._utils.headers import FEATURES_KEY, read_metadata
from avmsf._utils.text import RecordError, like
from avmsf.capture.filenames import PICTURE_SUFFIXES, VIDEO_SUFFIXES
from avmsf.capture.table import REQUIRED, read_table
from avmsf.errors import AvmsfError, FieldFileError
from avmsf.field.config import FIELD
from avmsf.pipeline.config import CACHE, CACHED_FIELD

FileKind = Literal[
    "a sound field", "features", "a recording", "a mesh or Gaussians", "a picture", "a video", "a folder"
]  # fmt: skip
"""Kinds of inputs that are told apart."""
_KINDS: dict[str, FileKind] = {
    **dict.fromkeys((".wav", ".flac", ".ogg", ".aif", ".aiff", ".mp3"), "a recording"),
    **dict.fromkeys((".ply", ".obj", ".glb", ".gltf", ".stl"), "a mesh or Gaussians"),
    **dict.fromkeys(PICTURE_SUFFIXES, "a picture"),
    **dict.fromkeys(VIDEO_SUFFIXES, "a video"),
}
"""Kinds by the endings of names."""
_FILE_SUFFIXES = (
    *(*_KINDS, ".csv", ".json", ".sfz", ".txt", ".toml", ".safetensors", ".gif", ".html", ".htm"),
    *(".gz", ".tar", ".zip", ".dsp", ".lib", ".uff", ".unv"),
)
"""Endings by which a name is that of a file: a folder's may have a dot too, as in bowl-1.2 or name.github.io."""


class InputError(AvmsfError):
    """An option is unknown, or names a file or folder that does not exist or is of another kind."""


class OutputError(AvmsfError):
    """An option or an output of a command cannot be used."""


@dataclass(frozen=True)
class Existing:
    """Marks a path that has to exist before a verb begins."""

    what: str
    kinds: tuple[FileKind, ...] = ()
    """What it may be; a file of no known kind is left to its reader."""
    columns: tuple[str, ...] = ()
    """What a table has to have."""

    def check(self, path: Path) -> None:
        """Raise `InputError` for no file or one of another kind, and as the readers of fields and of tables."""
        if not path.exists():
            raise InputError.expected(self.what, got="no such file or folder", file=path, advice="check the name")
        kind = kind_of(path)
        if kind is not None and kind not in self.kinds:
            cached = path / CACHE / CACHED_FIELD
            other = cached if "a sound field" in self.kinds and cached.is_file() else "another"
            raise InputError.expected(self.what, kind, got=kind, file=path, advice=f"name {other}")
        if "a sound field" in self.kinds and kind in (None, "a sound field"):
            FIELD.parse(FIELD.read_text(path), path)
        if self.columns:
            read_table(path, self.columns, (), advice=f"write a row for each impact below {','.join(self.columns)}")


@dataclass(frozen=True)
class New:
    """Marks the path of a file or a folder to write."""

    suffixes: tuple[str, ...] = ()
    """Endings of a file's format, in lower case; none for a folder."""
    or_folder: bool = False
    """Whether the path of a folder may be given instead of a file."""

    def check(self, path: Path) -> None:
        """Raise `OutputError` for a path where nothing can be written, and for the ending of another format."""
        suffix, folder = path.suffix.lower(), path.is_dir()
        if (self.or_folder or not self.suffixes) and (folder or suffix not in _FILE_SUFFIXES):
            expect_writable(path / "file")
            return
        if self.suffixes:
            expect_writable(path)
        if suffix not in self.suffixes:
            ending = f"a name that ends in {' or '.join(self.suffixes)}" if self.suffixes else ""
            wanted = ", or ".join(filter(None, [ending, "the name of a folder" * (self.or_folder or not ending)]))
            got, advice = path.suffix or "no ending", "rename it"
            raise OutputError.expected(wanted, path.suffix, got=got, file=path, name="suffix", advice=advice)


def arg(metavar: str, *aliases: str, name: str | None = None) -> Any:
    """Return how an option is shown: what its value is called, and no default, which its text gives if there is one."""
    return tyro.conf.arg(name=name, metavar=metavar, aliases=aliases or None, help_behavior_hint="")


FieldFile = tyro.conf.Positional[
    Annotated[
        Path,
        tyro.conf.arg(metavar="FIELD.safetensors", help="Field file, as `avmsf fit` writes it."),
        Existing("a sound field, as avmsf fit writes it", ("a sound field",)),
    ]
]
FieldFiles = Annotated[
    tuple[Path, ...], arg("FIELD ..."), Existing("sound fields, as avmsf fit writes them", ("a sound field",))
]
CaptureFolder = Annotated[
    Path, tyro.conf.arg(metavar="CAPTURE"), Existing("a capture folder, with impacts.csv", ("a folder",))
]
OtherCapture = Annotated[Path | None, arg("CAPTURE"), Existing("a capture folder", ("a folder",))]
ShapeFile = Annotated[Path | None, arg("MESH|PLY"), Existing("a mesh or Gaussians", ("a mesh or Gaussians",))]
SettingsFile = Annotated[Path | None, arg("FILE.toml"), Existing("a capture.toml")]
ContactData = Annotated[Path | None, arg("FOLDER"), Existing("ObjectFolder Real's contacts", ("a folder",))]
OutputFolder = Annotated[Path | None, arg("FOLDER", "-o"), New()]
PictureFolder = Annotated[Path | None, arg("FOLDER", "-o", "--plots"), New()]
PlotsFolder = Annotated[Path | None, arg("FOLDER"), New()]
CacheFolder = Annotated[Path | None, arg("FOLDER"), New()]
ContactTable = Annotated[Path | None, arg("TABLE.csv"), Existing("a table of contacts", columns=REQUIRED[1:])]
TruthTable = Annotated[Path | None, arg("TABLE.csv"), Existing("a table of contacts", columns=REQUIRED)]
PositionList = Annotated[tyro.conf.UseAppendAction[tuple[tuple[float, float, float], ...]], arg("X Y Z")]
"""Vectors, one for each time that the option is given."""


def expect_writable(path: Path) -> None:
    """Raise `OutputError` where no file can be written at `path`: before work of minutes."""
    if path.is_dir():
        raise OutputError.expected("the name of a file", "folder", got="a folder", file=path)
    folder = path.parent
    existing = next(place for place in (folder, *folder.resolve().parents) if place.exists())
    if not existing.is_dir():
        advice = f"choose another folder for {path.name}"
        raise OutputError.expected("a folder", "file", got="a file", file=existing, advice=advice)


def expect_free(path: Path, *, overwrite: bool, capture: str | None = None, guess: bool = False) -> None:
    """Raise `OutputError` for a file that only --overwrite replaces: all but an unedited field of the named capture.

    With `guess`, all but one that was computed without recordings.
    """
    if overwrite or not path.exists():
        return
    found = "another file"
    # What is no field of this version is a file like any other.
    with suppress(FieldFileError, RecordError):
        origin = like(FIELD.parse(FIELD.read_text(path), path).get("origin"), {}, "origin")
        report = like(origin.get("report"), {}, "origin.report")
        own = capture is not None and origin.get("capture") == capture and not report.get("edits")
        if own and (not guess or "guess" in report):
            return
        found = f"{'an edited' if report.get('edits') else 'a'} field of {origin.get('capture')!r}"
    advice = "choose another, or add --overwrite to replace it"
    raise OutputError.expected("a free name", found, got=found, file=path, name="--overwrite", advice=advice)


def path_mark(hint: Any) -> Existing | New | None:
    """Return what a type's paths have to be; None where it has no such mark."""
    for each in getattr(hint, "__metadata__", ()):
        if isinstance(each, Existing | New):
            return each
    return next((found for each in get_args(hint) if (found := path_mark(each)) is not None), None)


def kind_of(path: Path) -> FileKind | None:
    """Return what is at a path, by its name and its first bytes; None for what is not known."""
    if path.is_dir():
        return "a folder"
    if named := _KINDS.get(path.suffix.lower()):
        return named
    try:
        entries = read_metadata(path)
    except (OSError, ValueError):
        return None
    return "features" if FEATURES_KEY in entries else "a sound field" if FIELD.key in entries else None
