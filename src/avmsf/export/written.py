"""Output of exports: atomic files and folders that do not overwrite other files, and notes on losses."""

import json
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from avmsf._utils.text_files import read_json
from avmsf.errors import ExportError
from avmsf.files import temporary_path, way_out, write_whole

MANIFEST = "manifest.json"
_READ = 4096
"""Bytes at the beginning of a file that are searched for its generator."""
_MADE_HERE = re.compile(
    rb"""
      ^//\ .*\ as\ exported\ by\ avmsf\ \d    # Faust
    | \Acontact,x,y,z\r?\n0,             # contacts of Faust
    | "asset":\{[^{}]*"generator":"avmsf\ \d   # glTF
    | ^\ *151\ *\r?\n(.*\r?\n){5}avmsf\ \d           # universal, in its header
    | ^<!--\ avmsf\ \d[^\ ]*\ -->$            # a page
    """,
    re.MULTILINE | re.VERBOSE,
)
"""Marks of files that an export wrote, by format."""


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


def expect_ending(path: Path, endings: Sequence[str]) -> None:
    """Raise `ExportError` for a file's name that has none of these endings, dots included."""
    if path.suffix.lower() not in endings:
        raise ExportError(
            f"{path}: expected a name that ends in {' or '.join(endings)}, got {path.suffix or 'no ending'}; name it "
            f"{path.stem if path.suffix[1:].isalpha() else path.name}{endings[0]}",
            file=path,
            name="suffix",
            value=path.suffix,
        )


def no_modes(path: Path | None = None) -> ExportError:
    """Return the error for a field without a mode below half the sample rate."""
    return ExportError.expected(
        "1 or more below half the sample rate", 0, got="none", file=path, name="modes", advice="fit the field again"
    )


def write_file(path: Path, content: bytes, *, force: bool = False) -> dict[Path, int]:
    """Write one file atomically and return its size. Raises `ExportError` if another program's file exists there.

    A file counts as an export's if its first kilobytes contain the mark of its format, or if it has this content
    already.
    """
    expect_free(path, content, force=force)
    write_whole(path, lambda place: place.write_bytes(content), raising=ExportError)
    return {path: len(content)}


def expect_free(path: Path, content: bytes, *, force: bool = False) -> None:
    """Raise `ExportError` if `write_file` would."""
    if path.is_dir():
        raise ExportError(
            f"{path}: expected the name of a file, got a folder; name a file in it", file=path, value="folder"
        )
    if path.exists() and not force and not _made_here(path) and path.read_bytes() != content:
        raise _foreign(path, "a file")


def write_folder(
    folder: Path, fill: Callable[[Path], None], manifest: Mapping[str, object], *, force: bool = False
) -> dict[Path, int]:
    """Let `fill` write files into a temporary folder, add the manifest, and move all to `folder`; return the sizes.

    The manifest lists the files. A folder with no other files than its manifest lists is replaced as a whole. Other
    folders that are not empty are written to only with `force`, file by file, and nothing in them is removed. A link is
    followed. Raises `ExportError`.
    """
    place = folder.resolve()
    if folder.exists() and not folder.is_dir():
        raise ExportError(
            f"{folder}: expected a folder, or a free name, got a file; choose another", file=folder, value="file"
        )
    ours = not folder.exists() or not any(folder.iterdir()) or _folder_made_here(folder)
    if not ours and not force:
        raise _foreign(folder, "a folder with files")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_path(place)
        temporary.mkdir()
        try:
            fill(temporary)
            names = sorted(str(path.relative_to(temporary)) for path in temporary.rglob("*") if path.is_file())
            content = {"generator": generator(), **manifest, "files": [*names, MANIFEST]}
            (temporary / MANIFEST).write_text(json.dumps(content, indent=1) + "\n")
            sizes = {folder / name: (temporary / name).stat().st_size for name in [*names, MANIFEST]}
            _place(temporary, place, whole=ours)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ExportError.expected("a writable folder", reason, file=folder, advice=way_out(error)) from error
    return sizes


def _place(temporary: Path, folder: Path, *, whole: bool) -> None:
    if not whole:
        for path in sorted(temporary.rglob("*")):
            if path.is_file():
                place = folder / path.relative_to(temporary)
                place.parent.mkdir(parents=True, exist_ok=True)
                os.replace(path, place)
        return
    if folder.exists():
        # A folder cannot be replaced atomically: the old one is renamed until the new one is in place.
        aside = temporary.with_suffix(".old")
        os.replace(folder, aside)
        try:
            os.replace(temporary, folder)
        except OSError:
            os.replace(aside, folder)
            raise
        shutil.rmtree(aside, ignore_errors=True)
    else:
        os.replace(temporary, folder)


def _made_here(path: Path) -> bool:
    with path.open("rb") as file:
        return _MADE_HERE.search(file.read(_READ)) is not None


def _folder_made_here(folder: Path) -> bool:
    """Return whether a folder has only files that the manifest of an export lists."""
    try:
        manifest = read_json(folder / MANIFEST)
        listed = set(manifest["files"]) if manifest["generator"].startswith("avmsf ") else set()
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return False
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} <= listed


def _foreign(path: Path, what: str) -> ExportError:
    return ExportError(
        f"{path}: expected a free name or an earlier export, got {what} that no export wrote; choose another name, or "
        "add --overwrite to replace files of the same names",
        file=path,
        name="--overwrite",
        value=what,
    )
