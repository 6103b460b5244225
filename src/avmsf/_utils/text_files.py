"""Text, JSON and TOML from files that others wrote: bounded in size and depth before they take memory and time.

Every function raises `OSError` where the file cannot be read and `ValueError` for contents that cannot be used, so
that each reader gives its own error with the file's name.
"""

import io
import json
import tomllib
from pathlib import Path
from typing import Any

MAX_TEXT_BYTES = 16 << 20
"""Largest table or JSON that is read: 25,000 frames of a transforms.json, or 200,000 rows of a table of contacts.
JSON of this length takes at most about 0.5 GB as Python objects."""
MAX_TOML_BYTES = 16 << 10
"""Largest TOML file that is read: four times all settings of a capture with a comment each. Python's reader takes time
and memory that grow with the square of a dotted key's length: 1 s and 0.3 GB for one of this length."""


def read_text(path: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return a file's UTF-8 text without a byte-order mark, lines ended by a line feed whatever the file has."""
    with open(path, "rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise ValueError(f"expected at most {max_bytes:,} bytes, got more")
    return io.StringIO(content.decode("utf-8-sig"), newline=None).read()


def parse_json(text: str, *, max_characters: int = MAX_TEXT_BYTES) -> Any:
    """Return what a JSON text holds."""
    if len(text) > max_characters:
        raise ValueError(f"expected at most {max_characters:,} characters of JSON, got {len(text):,}")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("expected a few levels of lists and objects, got hundreds") from error


def read_json(path: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Return what a JSON file holds."""
    return parse_json(read_text(path, max_bytes=max_bytes), max_characters=max_bytes)


def read_toml(path: Path) -> dict[str, Any]:
    """Return the table of a TOML file."""
    text = read_text(path, max_bytes=MAX_TOML_BYTES)
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("expected a few levels of tables, got hundreds") from error
