"""Output of exports: atomic files, and folders, that replace others only if asked to, and notes on losses."""

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from avmsf._utils.files import temporary_path, way_out, write_whole
from avmsf.errors import ExportError

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
        raise ExportError.expected(
            f"a name that ends in {' or '.join(endings)}",
            path.suffix,
            got=path.suffix or "no ending",
            file=path,
            name="suffix",
            advice=f"name it {path.stem if path.suffix[1:].isalpha() else path.name}{endings[0]}",
        )


def no_modes(path: Path | None = None) -> ExportError:
    """Return the error for a field without a mode below half the sample rate."""
    return ExportError.expected(
        "1 or more below half the sample rate", 0, got="none", file=path, name="modes", advice="fit the field again"
    )


def pack(arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return arrays one after another, little endian, each from a multiple of four bytes on; and where each is."""
    content, records = bytearray(), {}
    for name, array in arrays.items():
        content += b"\0" * (-len(content) % 4)
        records[name] = {"offset": len(content), "dtype": array.dtype.name, "shape": list(array.shape)}
        content += np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
    return bytes(content), records


def write_file(path: Path, content: bytes, *, force: bool = False) -> dict[Path, int]:
    """Write one file atomically and return its size. Raises `ExportError` if it exists, unless `force` is set."""
    check_free(path, force=force)
    write_whole(path, lambda place: place.write_bytes(content), raising=ExportError)
    return {path: len(content)}


def check_free(path: Path, *, folder: bool = False, force: bool = False) -> None:
    """Raise `ExportError` if `write_file`, or `write_folder`, would for what exists there."""
    if not path.exists():
        return
    if path.is_dir() != folder:
        wanted, found = ("folder", "file") if folder else ("file", "folder")
        raise ExportError.expected(
            f"a free name, or a {wanted}", found, got=f"a {found}", file=path, advice="choose another name"
        )
    if not force and not (folder and not any(path.iterdir())):
        found = "a folder with files" if folder else "a file"
        advice = "choose another, or add --overwrite to replace it"
        raise ExportError.expected("a free name", found, got=found, file=path, name="--overwrite", advice=advice)


def write_folder(
    folder: Path, fill: Callable[[Path], None], manifest: Mapping[str, object], *, force: bool = False
) -> dict[Path, int]:
    """Let `fill` write files into a temporary folder, add the manifest, and move all to `folder`; return the sizes.

    The manifest lists the files. With `force` they replace those of the same names, and others stay. Raises
    `ExportError` for a folder with files, unless `force` is set.
    """
    check_free(folder, folder=True, force=force)
    try:
        temporary = temporary_path(folder.resolve())
        temporary.mkdir(parents=True)
        try:
            fill(temporary)
            names = sorted(str(path.relative_to(temporary)) for path in temporary.rglob("*") if path.is_file())
            content = {"generator": generator(), **manifest, "files": [*names, MANIFEST]}
            (temporary / MANIFEST).write_text(json.dumps(content, indent=1) + "\n")
            sizes = {folder / name: (temporary / name).stat().st_size for name in [*names, MANIFEST]}
            for path in sizes:
                path.parent.mkdir(parents=True, exist_ok=True)
                os.replace(temporary / path.relative_to(folder), path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ExportError.expected("a writable folder", reason, file=folder, advice=way_out(error)) from error
    return sizes
