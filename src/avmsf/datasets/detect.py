"""Which dataset a folder holds, by its files' names; and where it holds none, which folder may have been meant."""

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Literal, NamedTuple

from avmsf.capture.table import TABLE
from avmsf.errors import DatasetError

Kind = Literal["captures", "ObjectFolder Real", "RealImpact"]
"""What reports call the datasets."""
FOLDER, SOUNDS = "preprocessed", "deconvolved_0db.npy"
"""RealImpact's folder of an object's arrays, and its sounds."""
ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z")
SOUGHT = (
    f"a capture folder or a folder of them ({TABLE}), ObjectFolder Real (OBJECT/audio/CONTACT/mic.wav), or "
    f"RealImpact (NUMBER_NAME/{FOLDER}/{SOUNDS})"
)


def expect_signs(path: str | Path) -> Kind:
    """Return the kind of dataset that a folder holds. Raises `DatasetError` for a folder that holds none."""
    folder = Path(path)
    if not folder.is_dir():
        raise _no_folder(folder)
    kind = _kind(folder)
    if kind is None:
        guess = _guess(folder)
        raise DatasetError(f"{folder}: expected {SOUGHT}, {guess.message}", file=folder, value=guess.found)
    return kind


def _kind(folder: Path) -> Kind | None:
    """Return the kind of dataset that the folder holds, or None."""
    signs: Sequence[tuple[Kind, str]] = (
        ("captures", TABLE),
        ("ObjectFolder Real", "[0-9]*/audio/[0-9]*/*.wav"),
        ("RealImpact", f"[!.]*/{FOLDER}/*.npy"),
        ("captures", f"[!.]*/{TABLE}"),
    )
    # A folder with the recordings of one raw object has audio/CONTACT/mic.wav, which no sign of these matches.
    return next((kind for kind, pattern in signs if _any(folder, pattern)), None)


class _Guess(NamedTuple):
    """What a folder holds in place of a dataset."""

    message: str
    """What was found, and what to do."""
    found: str | tuple[str, ...]
    """The folder to name, or the names of what was found."""


def _guess(folder: Path) -> _Guess:
    """Return what the folder holds instead of a dataset."""
    guesses: Sequence[Callable[[Path], _Guess | None]] = (
        _too_low,
        _too_high,
        _half_raw,
        _half_realimpact,
        _packed,
    )
    for guess in guesses:
        found = guess(folder)
        if found is not None:
            return found
    names = sorted(path.name + "/" * path.is_dir() for path in folder.iterdir() if path.name[0] != ".")
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    return _Guess(f"got {', '.join(names[:8])}{more}" if names else "got an empty folder", tuple(names))


def _too_low(folder: Path) -> _Guess | None:
    """Recognize the folder of one object, or a part of it."""
    signs = (
        (f"{FOLDER}/*.npy", "one object of RealImpact", 1),
        ("vertexXYZ.npy", "the arrays of one object of RealImpact", 2),
        ("audio/[0-9]*/mic.wav", "one object of ObjectFolder Real", 1),
        ("[0-9]*/mic.wav", "the contacts of one object of ObjectFolder Real", 2),
        ("mic.wav", "one recording of ObjectFolder Real", 3),
    )
    for pattern, what, levels in signs:
        if _any(folder, pattern):
            parent = folder.resolve().parents[levels - 1]
            return _Guess(f"got {what}; name the folder {parent}", str(parent))
    return None


def _too_high(folder: Path) -> _Guess | None:
    """Recognize a parent folder of datasets."""
    below = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != "."]
    found = [(path, kind) for path in below if (kind := _kind(path)) is not None]
    if not found:
        return None
    shown = " or ".join(f"{path} ({kind})" for path, kind in found[:4])
    return _Guess(f"name the folder {shown}", tuple(str(path) for path, _ in found))


def _half_raw(folder: Path) -> _Guess | None:
    objects = [path.name for path in folder.iterdir() if path.name.isdecimal() and path.is_dir()]
    if not objects:
        return None
    if _any(folder, "[0-9]*/audio"):
        return _Guess("got ObjectFolder Real without recordings; unpack the audio archives again", "audio/")
    found = tuple(sorted(objects, key=int)[:5])
    return _Guess(
        f"got folders {', '.join(found)} without audio/; if they are ObjectFolder Real's objects, unpack "
        "audio_data_1_10.tar.gz and so on here (videos and tactile data are not used)",
        found,
    )


def _half_realimpact(folder: Path) -> _Guess | None:
    below = sorted(path.name for path in folder.glob(f"*/{FOLDER}") if path.is_dir())
    message = f"got {FOLDER}/ without arrays; unpack RealImpact's archives again"
    return _Guess(message, f"{FOLDER}/") if below else None


def _packed(folder: Path) -> _Guess | None:
    archives = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in ARCHIVES)
    if not archives:
        return None
    command = "unzip" if archives[0].endswith(".zip") else "tar -xf"
    more = f" and {len(archives) - 4} more" if len(archives) > 4 else ""
    message = f"got archives, {', '.join(archives[:4])}{more}; unpack them, `{command} {archives[0]}` in {folder}"
    return _Guess(message, tuple(archives))


def _no_folder(path: Path) -> DatasetError:
    if path.is_file():
        advice = "; unpack it and name the folder" if path.suffix.lower() in ARCHIVES else ""
        return DatasetError(f"{path}: expected a folder, got a file{advice}", file=path, value="file")
    near: list[str] = []
    if path.parent.is_dir():
        near = get_close_matches(path.name, [each.name for each in path.parent.iterdir() if each.is_dir()], n=1)
    meant = f"; did you mean {path.parent / near[0]}?" if near else ""
    return DatasetError(f"{path}: expected a folder, got none{meant}", file=path, value=tuple(near))


def _any(folder: Path, pattern: str) -> bool:
    return next(folder.glob(pattern), None) is not None
