"""What all writers share: the names of formats, packed arrays, files and folders that are whole, notes on losses."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Shaped

from avmsf._utils.files import new_folder, write_whole
from avmsf._utils.text import read_json
from avmsf.errors import ExportError

Format = Literal["web", "gltf", "faust", "avmsf-demo", "wavs", "uff"]
Precision = Literal["float16", "float32"]
Axis = Literal["x", "y", "z"]
MAX_POINTS = 20_000
"""Default number of contacts of a page: 20 MB with 128 modes."""


class Target(NamedTuple):
    """What belongs to a format."""

    points: int
    """Default number of contacts, which its tools read quickly."""
    suffixes: tuple[str, ...] = ()
    """Of a format in one file; a page may be a folder too."""


FORMATS: dict[Format, Target] = {
    "web": Target(MAX_POINTS, (".html", ".htm")),
    "gltf": Target(2000, (".glb",)),
    "faust": Target(64, (".dsp", ".lib")),
    "avmsf-demo": Target(10_000),
    "wavs": Target(16),
    "uff": Target(1000, (".uff", ".unv")),
}
MANIFEST = "manifest.json"


@dataclass(frozen=True, eq=False)
class Written:
    """The files of an export, and their error."""

    sizes: Mapping[Path, int]
    """Bytes of each file."""
    remarks: tuple[str, ...] = ()
    """Notes on what the format cannot represent."""
    error: float = 0.0
    """Largest difference between the file's sound and `SampledField.render`, relative to the largest sample."""
    spectrum_error_db: float | None = None
    """Mean difference of their short-time magnitude spectra, dB, weighted by the field's energy; None: not measured."""

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(self.sizes.values())


def generator() -> str:
    """Return the name and version that files hold."""
    return f"avmsf {version('avmsf')}"


def check_suffix(path: Path, endings: Sequence[str]) -> None:
    """Raise `ExportError` for a file's name that has none of these endings, dots included."""
    if path.suffix.lower() not in endings:
        wanted, got = f"a name that ends in {' or '.join(endings)}", path.suffix or "no ending"
        advice = f"name it {path.stem if path.suffix[1:].isalpha() else path.name}{endings[0]}"
        raise ExportError.expected(wanted, path.suffix, got=got, file=path, name="suffix", advice=advice)


def pack(arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return arrays one after another, little endian, each from a multiple of four bytes on; and where each is."""
    content, records = bytearray(), {}
    for name, array in arrays.items():
        content += b"\0" * (-len(content) % 4)
        records[name] = {"offset": len(content), "dtype": array.dtype.name, "shape": list(array.shape)}
        content += np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
    return bytes(content), records


def write_files(contents: Mapping[Path, bytes], *, overwrite: bool = False) -> dict[Path, int]:
    """Write files, each atomically, and return the sizes. Raises `ExportError` if one exists, unless `overwrite`."""
    for path in contents:
        check_free(path, overwrite=overwrite)
    for path, content in contents.items():
        write_whole(path, content, raising=ExportError)
    return {path: len(content) for path, content in contents.items()}


def write_folder(
    folder: Path, files: Mapping[str, bytes], manifest: Mapping[str, object], *, overwrite: bool = False
) -> dict[Path, int]:
    """Write files by their relative paths, and a manifest that lists them, all or none; return the sizes.

    Raises `ExportError` for a folder with files; with `overwrite` it is replaced if it has the files of an export and
    no others.
    """
    check_free(folder, folder=True, overwrite=overwrite)
    record = {"generator": generator(), **manifest, "files": [*sorted(files), MANIFEST]}
    contents = {**files, MANIFEST: (json.dumps(record, indent=1) + "\n").encode()}
    with new_folder(folder, raising=ExportError, replace=overwrite) as begun:
        for name, content in contents.items():
            (begun / name).parent.mkdir(parents=True, exist_ok=True)
            (begun / name).write_bytes(content)
    return {folder / name: len(content) for name, content in contents.items()}


def check_free(path: Path, *, folder: bool = False, overwrite: bool = False) -> None:
    """Raise `ExportError` if `write_files`, or `write_folder`, would for what exists there."""
    if not path.exists():
        return
    if path.is_dir() != folder:
        wanted, other = ("folder", "file") if folder else ("file", "folder")
        advice = "choose another name"
        raise ExportError.expected(f"a free name, or a {wanted}", other, got=f"a {other}", file=path, advice=advice)
    found = [path.name]
    if folder:
        found = sorted(each.relative_to(path).as_posix() for each in path.rglob("*") if each.is_file())
    wanted, advice = "a free name", "choose another, or replace it with --overwrite (in Python overwrite=True)"
    if others := sorted(set(found) - _exported(path)) if folder else []:
        advice = "choose another folder, or remove its files"
    if overwrite:
        wanted, found = "a folder with the files of an export alone", others
    if found:
        got = f"{found[0]} in it" if folder else "a file"
        raise ExportError.expected(wanted, found, got=got, file=path, name="--overwrite", advice=advice)


def _exported(folder: Path) -> set[str]:
    """Return the files that a folder's manifest, written here, lists."""
    try:
        manifest = read_json(folder / MANIFEST)
        return set(manifest["files"]) if str(manifest["generator"]).startswith("avmsf ") else set()
    except (OSError, ValueError, KeyError, TypeError):
        return set()
