"""Which dataset a folder holds, by its files' names; and where it holds none, which folder may have been meant."""

from difflib import get_close_matches
from pathlib import Path
from typing import Literal

from avmsf._utils.text import listed
from avmsf.capture.settings import TABLE
from avmsf.errors import DatasetError

Kind = Literal["captures", "ObjectFolder Real", "RealImpact"]
"""What reports call the datasets."""
ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z")
_KINDS: tuple[tuple[Kind, str], ...] = (
    ("captures", TABLE),
    ("ObjectFolder Real", "[0-9]*/audio/[0-9]*/*.wav"),
    ("RealImpact", "[!.]*/preprocessed/*.npy"),
    ("captures", f"[!.]*/{TABLE}"),
)
_PARTS = (
    ("preprocessed/*.npy", "one object of RealImpact", 1),
    ("vertexXYZ.npy", "the arrays of one object of RealImpact", 2),
    ("audio/[0-9]*/mic.wav", "one object of ObjectFolder Real", 1),
    ("[0-9]*/mic.wav", "the contacts of one object of ObjectFolder Real", 2),
    ("mic.wav", "one recording of ObjectFolder Real", 3),
)
"""What a folder inside a dataset holds, what that is, and how many levels up the dataset's folder lies."""


def detect_dataset(path: str | Path) -> Kind:
    """Return the kind of dataset that a folder holds. Raises DatasetError for a folder that holds none.

    Its value is the folder or the folders to name instead, or else the names of what was found.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise _no_folder(folder)
    kind = _kind(folder)
    if kind is None:
        found, value = _explain(folder)
        wanted = (
            f"a capture folder or a folder of them ({TABLE}), ObjectFolder Real (OBJECT/audio/CONTACT/mic.wav), or "
            "RealImpact (NUMBER_NAME/preprocessed/deconvolved_0db.npy)"
        )
        raise DatasetError(f"{folder}: expected {wanted}, {found}", file=folder, value=value)
    return kind


def _kind(folder: Path) -> Kind | None:
    # A folder with the recordings of one raw object has audio/CONTACT/mic.wav, which no pattern of these matches.
    return next((kind for kind, pattern in _KINDS if _any(folder, pattern)), None)


def _explain(folder: Path) -> tuple[str, str | tuple[str, ...]]:
    """Return what a folder holds in place of a dataset with what to do, and the folder to name or what was found."""
    for pattern, what, levels in _PARTS:
        if _any(folder, pattern):
            parent = str(folder.resolve().parents[levels - 1])
            return f"got {what}; name the folder {parent}", parent
    paths = sorted(path for path in folder.iterdir() if path.name[0] != ".")
    datasets = [(str(path), kind) for path in paths if path.is_dir() and (kind := _kind(path)) is not None]
    if datasets:
        shown = " or ".join(f"{path} ({kind})" for path, kind in datasets[:4])
        return f"name the folder {shown}", tuple(path for path, _ in datasets)
    if _any(folder, "[0-9]*/audio"):
        return "got ObjectFolder Real without recordings; unpack the audio archives again", "audio/"
    if _any(folder, "*/preprocessed/"):
        return "got preprocessed/ without arrays; unpack RealImpact's archives again", "preprocessed/"
    archives = tuple(path.name for path in paths if path.suffix.lower() in ARCHIVES)
    if archives:
        command = "unzip" if archives[0].endswith(".zip") else "tar -xf"
        return f"got archives, {listed(archives, most=8)}; unpack them, `{command} {archives[0]}` in {folder}", archives
    names = tuple(path.name + "/" * path.is_dir() for path in paths)
    numbers = any(path.name.isdecimal() and path.is_dir() for path in paths)
    advice = "; if numbers are ObjectFolder Real's objects, unpack audio_data_1_10.tar.gz and so on here" * numbers
    return f"got {listed(names, most=8)}{advice}" if names else "got an empty folder", names


def _no_folder(path: Path) -> DatasetError:
    if path.is_file():
        advice = "unpack it and name the folder" if path.suffix.lower() in ARCHIVES else ""
        return DatasetError.expected("a folder", "file", got="a file", file=path, advice=advice)
    near: list[str] = []
    if path.parent.is_dir():
        near = get_close_matches(path.name, [each.name for each in path.parent.iterdir() if each.is_dir()], n=1)
    meant = f"did you mean {path.parent / near[0]}?" if near else ""
    return DatasetError.expected("a folder", tuple(near), got="none", file=path, advice=meant)


def _any(folder: Path, pattern: str) -> bool:
    return next(folder.glob(pattern), None) is not None
