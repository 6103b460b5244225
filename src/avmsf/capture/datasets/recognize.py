"""Which dataset a folder holds; and where it holds none, what its owner may have meant."""

from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path

from avmsf.capture.datasets.collection import CaptureCollection
from avmsf.capture.datasets.dataset import Dataset
from avmsf.capture.datasets.objectfolder_compact import PARTS, ObjectFolderCompact
from avmsf.capture.datasets.objectfolder_raw import ObjectFolderRaw
from avmsf.capture.datasets.realimpact import FOLDER, SOUNDS, RealImpact
from avmsf.capture.table import TABLE
from avmsf.errors import DatasetError

ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z")
SOUGHT = (
    f"a capture folder or a folder of them ({TABLE}), ObjectFolder Real (OBJECT/audio/CONTACT/mic.wav), its compact "
    f"copy (audio/OBJECT/CONTACT.wav beside contacts/), or RealImpact (NUMBER_NAME/{FOLDER}/{SOUNDS})"
)


def open_dataset(path: str | Path, *, contacts: str | Path | None = None, table: str | Path | None = None) -> Dataset:
    """Return the dataset that a folder holds, recognized by what lies in it.

    `contacts` says where ObjectFolder Real's contacts are, `table` where its objects' names (`ObjectFolderRaw`). Where
    the raw and the compact form share a folder the raw one is taken, which knows the forces. Raises DatasetError for a
    folder that holds none, with what was sought and found and what may have been meant, and for options that the
    dataset does not take.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise DatasetError(_no_folder(folder))
    kind = _kind(folder)
    if kind is None:
        raise DatasetError(f"{folder}: expected {SOUGHT}; {_guess(folder)}")
    if contacts is not None and kind is not ObjectFolderRaw:
        raise DatasetError(f"{folder}: holds {kind.name}, which has contacts of its own: leave `contacts` out")
    if table is not None and kind not in (ObjectFolderRaw, ObjectFolderCompact):
        raise DatasetError(f"{folder}: holds {kind.name}, whose objects have names of their own: leave `table` out")
    if kind is ObjectFolderRaw:
        return ObjectFolderRaw(folder, contacts=contacts, table=table)
    if kind is ObjectFolderCompact:
        return ObjectFolderCompact(folder, table=table)
    return kind(folder)


Kind = type[CaptureCollection] | type[ObjectFolderRaw] | type[ObjectFolderCompact] | type[RealImpact]


def _kind(folder: Path) -> Kind | None:
    """Return the class that reads the folder, or None."""
    signs: Sequence[tuple[Kind, str]] = (
        (CaptureCollection, TABLE),
        (ObjectFolderRaw, "[0-9]*/audio/[0-9]*/*.wav"),
        (ObjectFolderCompact, "audio/[0-9]*/[0-9]*.wav"),
        (RealImpact, f"[!.]*/{FOLDER}/*.npy"),
        (CaptureCollection, f"[!.]*/{TABLE}"),
    )
    # A folder with the recordings of one raw object has audio/CONTACT/mic.wav, which no sign of these matches.
    return next((kind for kind, pattern in signs if _any(folder, pattern)), None)


def _guess(folder: Path) -> str:
    """Return what the folder holds instead, and what its owner should do."""
    guesses: Sequence[Callable[[Path], str | None]] = (
        _too_low,
        _too_high,
        _half_compact,
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
    return f"found {', '.join(names[:8])}{more}" if names else "the folder is empty"


def _too_low(folder: Path) -> str | None:
    """The folder of one object, or a part of it."""
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
            return f"found {what}: name the folder {'above' if levels == 1 else f'{levels} levels above'}, {parent}"
    for levels, pattern in enumerate(("[0-9]*/[0-9]*.wav", "[0-9]*.wav")):
        place = [folder.resolve(), *folder.resolve().parents][levels]
        if place.name == "audio" and _any(folder, pattern):
            return f"found recordings of the compact copy: name the folder around audio/, {place.parent}"
    return None


def _too_high(folder: Path) -> str | None:
    """A folder around the dataset."""
    below = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != "."]
    found = [(path, kind) for path in below if (kind := _kind(path)) is not None]
    if not found:
        return None
    shown = ", ".join(f"{path} ({kind.name})" for path, kind in found[:4])
    return f"found {'it one level below' if len(found) == 1 else 'several one level below'}: name {shown}"


def _half_compact(folder: Path) -> str | None:
    there = [part for part in PARTS if (folder / part).exists()]
    if len(there) < 2 and "split.json" not in there:
        return None
    lacking = [f"{part}{_archive_of(folder, part)}" for part in PARTS if part not in there]
    if "audio" in there:
        lacking.append("recordings in audio/")
    return f"found part of the compact copy ({', '.join(there)}): {', '.join(lacking)} still missing"


def _half_raw(folder: Path) -> str | None:
    objects = [path.name for path in folder.iterdir() if path.name.isdecimal() and path.is_dir()]
    if not objects:
        return None
    if _any(folder, "[0-9]*/audio"):
        return "found folders of ObjectFolder Real's objects without recordings: unpack the audio archives again"
    return (
        f"found folders {', '.join(sorted(objects, key=int)[:5])} without audio/ in them: if these are ObjectFolder "
        "Real's objects, unpack audio_data_1_10.tar.gz and so on here; videos and tactile data are not used"
    )


def _half_realimpact(folder: Path) -> str | None:
    below = sorted(path.name for path in folder.glob(f"*/{FOLDER}") if path.is_dir())
    return f"found {FOLDER}/ without arrays in it: unpack RealImpact's archives again" if below else None


def _packed(folder: Path) -> str | None:
    archives = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in ARCHIVES)
    if not archives:
        return None
    command = "unzip" if archives[0].endswith(".zip") else "tar -xf"
    more = f" and {len(archives) - 4} more" if len(archives) > 4 else ""
    return (
        f"found archives that are not unpacked, {', '.join(archives[:4])}{more}: `{command} {archives[0]}` in {folder}"
    )


def _archive_of(folder: Path, part: str) -> str:
    packed = folder / f"{part}.tar.gz"
    return f" (unpack {packed.name})" if packed.is_file() else ""


def _no_folder(path: Path) -> str:
    if path.is_file():
        packed = path.suffix.lower() in ARCHIVES
        return f"{path}: is {'an archive: unpack it and name the folder' if packed else 'a file; expected a folder'}"
    near: list[str] = []
    if path.parent.is_dir():
        near = get_close_matches(path.name, [each.name for each in path.parent.iterdir() if each.is_dir()], n=1)
    return f"{path}: there is no such folder" + (f" (did you mean {path.parent / near[0]}?)" if near else "")


def _any(folder: Path, pattern: str) -> bool:
    return next(folder.glob(pattern), None) is not None
