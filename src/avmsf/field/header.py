"""The header of a field's file, which tells whether this version reads it. Importing this loads no torch."""

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from avmsf._utils.headers import read_header_text
from avmsf._utils.text import parse_json
from avmsf.errors import AvmsfError, FieldFileError

FORMAT = 8
"""Number of this format; it grows with every change that older versions could not read. Later versions read it."""
KEY = "avmsf"
"""Entry of a file's metadata that holds a field's record."""
WHAT, ADVICE = "a sound field", "fit and save it again"
UNREADABLE = (ValueError, TypeError, KeyError, RuntimeError, AvmsfError)
"""What a record of another form raises; RuntimeError: torch, of sizes beyond 2^63 and of damaged values."""


def read_record(path: Path) -> dict[str, Any]:
    """Return the record of a field's file. Raises FieldFileError for another file and for another format."""
    return record_of_text(read_header_text(path, KEY, what=WHAT, advice=ADVICE, raising=FieldFileError), path)


def record_of_text(words: str, path: Path) -> dict[str, Any]:
    """Return the record that a file's text holds. Raises FieldFileError for another one and for another format."""
    try:
        record = parse_json(words)
        found, writer = record["format"], record["version"]
        if found != FORMAT:
            raise FieldFileError(
                f"{path}: expected a sound field of format {FORMAT}, got format {found} of avmsf {writer} "
                f"(this is avmsf {version('avmsf')}); "
                + (_remake(record, path) if isinstance(found, int) and found < FORMAT else "install a newer avmsf"),
                file=path,
                name="format",
                value=found,
            )
    except FieldFileError:
        raise
    except UNREADABLE as error:
        raise damaged(path, error) from error
    return dict(record)


def damaged(path: Path, error: Exception) -> FieldFileError:
    """Return the error of a file whose record or tensors raised another one."""
    return FieldFileError(
        f"{path}: expected the header of a sound field of format {FORMAT}, got another or a damaged one "
        f"({type(error).__name__}: {error}); fit and save the field again",
        file=path,
        name=error.name
        if isinstance(error, AvmsfError)
        else str(error.args[0])
        if isinstance(error, KeyError)
        else None,
        value=error.value if isinstance(error, AvmsfError) else None,
    )


def _remake(record: Mapping[str, Any], path: Path) -> str:
    """Return the command that makes the field of an older file again."""
    report = record["origin"]["report"]
    material = f" --material {report['material']['name']}" if "guess" in report else ""
    capture = record["origin"]["capture"]
    return f"fit it again: avmsf fit FOLDER{material} --output {path}, where FOLDER is that of {capture!r}"
