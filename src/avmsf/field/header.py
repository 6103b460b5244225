"""The header of a field's file, which tells whether this version reads it. Importing this loads no torch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from avmsf._utils.headers import FileKind
from avmsf.errors import FieldFileError

FORMAT = 8
"""Number of this format; it grows with every change that older versions could not read. Later versions read it."""
FIELD = FileKind("avmsf", "a sound field", "fit and save it again", FieldFileError, formats=(FORMAT,))


def read_record(path: Path) -> dict[str, Any]:
    """Return the record of a field's file. Raises FieldFileError for another file and for another format."""
    return record_of_text(FIELD.read_text(path), path)


def record_of_text(text: str, path: Path) -> dict[str, Any]:
    """Return the record that a file's text holds. Raises FieldFileError for another one and for another format."""
    return FIELD.parse(text, path, remake=_remake)


def _remake(record: Mapping[str, Any], path: Path) -> str:
    """Return the command that makes the field of an older file again."""
    report = record["origin"]["report"]
    material = f" --material {report['material']['name']}" if "guess" in report else ""
    capture = record["origin"]["capture"]
    return f"fit it again: avmsf fit FOLDER{material} --output {path}, where FOLDER is that of {capture!r}"
