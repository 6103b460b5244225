"""The header of a safetensors file and the JSON in it, read without the library that reads its tensors.

That one takes seconds to load.
"""

import json
import struct
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from avmsf._utils.text import parse_json
from avmsf.errors import AvmsfError

MAX_HEADER_BYTES = 100_000_000
"""Longest header, as the format bounds it."""
FEATURES_KEY = "avmsf_features"
"""Entry of a file's metadata that holds the record of features."""


def read_header_text(path: Path, key: str, *, what: str, advice: str, raising: type[AvmsfError]) -> str:
    """Return the text under `key` in the metadata of a safetensors file.

    Raises `raising` for a file that is missing, damaged or of another kind: `what` it should be, and the `advice`.
    """
    if not path.exists():
        raise raising(f"{path}: expected {what}, got no such file; check the name, or {advice}", file=path)
    try:
        metadata = read_metadata(path)
    except (OSError, ValueError) as error:
        raise unreadable(path, what=what, advice=advice, raising=raising) from error
    if key not in metadata:
        wanted, got = f"{what} with the metadata entry {key!r}", "another safetensors file"
        advice = f"name another, or {advice}"
        raise raising.expected(wanted, sorted(metadata), got=got, file=path, name=key, advice=advice)
    return metadata[key]


def parse_record(
    text: str,
    path: Path,
    check: Callable[[dict[str, Any]], None],
    *,
    formats: tuple[int, ...],
    what: str,
    advice: str,
    raising: type[AvmsfError],
) -> dict[str, Any]:
    """Return the record that a file's header has as JSON, with a `format` and the `version` that wrote it.

    `check` raises ValueError, TypeError or KeyError for a record whose entries are not those of the formats. Raises
    `raising` for such a record, and for a format of another version.
    """
    try:
        record = parse_json(text)
        found, writer = record["format"], record["version"]
        if found in formats:
            check(record)
    except (ValueError, TypeError, KeyError) as error:
        got = f"a damaged one ({type(error).__name__}: {error})"
        raise raising.expected(f"the header of {what}", got=got, file=path, name="header", advice=advice) from error
    if found not in formats:
        wanted = f"{what} in format {' or '.join(map(str, formats))}"
        got = f"format {found}, written by avmsf {writer} (this is avmsf {version('avmsf')})"
        if isinstance(found, int) and found > max(formats):
            advice = f"install avmsf {writer} or newer, or {advice}"
        raise raising.expected(wanted, found, got=got, file=path, name="format", advice=advice)
    return record


def record_text(record: Mapping[str, Any], path: Path, *, name: str, raising: type[AvmsfError]) -> str:
    """Return a record as JSON. Raises `raising` for what JSON does not hold, which came in its entry `name`."""
    try:
        return json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        wanted, got = "finite numbers, text, lists and dicts", f"other values ({error})"
        raise raising.expected(wanted, str(error), got=got, file=path, name=name) from error


def unreadable(path: Path, *, what: str, advice: str, raising: type[AvmsfError]) -> AvmsfError:
    """Return the error of a file that safetensors cannot read."""
    found, helps = _guess(path, advice)
    return raising(f"{path}: expected {what}, got {found}; {helps}", file=path, value=found)


def read_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a safetensors file. Raises OSError or ValueError where there is none to read."""
    with path.open("rb") as file:
        start = file.read(8)
        length = struct.unpack("<Q", start)[0] if len(start) == 8 else 0
        if not 0 < length <= MAX_HEADER_BYTES:
            raise ValueError(f"expected a header of 1 to {MAX_HEADER_BYTES} bytes, got {length}")
        header = file.read(length)
    if len(header) < length:
        raise ValueError(f"expected {length} bytes of header, got {len(header)}")
    try:
        found = json.loads(header)
    except RecursionError as error:
        raise ValueError("expected a few levels of objects, got hundreds") from error
    metadata = found.get("__metadata__", {}) if isinstance(found, dict) else None
    if not isinstance(metadata, dict) or not all(isinstance(each, str) for each in metadata.values()):
        raise ValueError("expected an object of texts as metadata, got another value")
    return metadata


def _guess(path: Path, advice: str) -> tuple[str, str]:
    """Return what a file is that safetensors cannot read, and what to do."""
    if path.is_dir():
        return "a folder", "name the file in it"
    try:
        with open(path, "rb") as file:
            start = file.read(9)
    except OSError as error:
        return f"an unreadable file ({error.strerror})", "check its permissions"
    if not start:
        return "an empty file", f"copy it again, or {advice}"
    # Eight bytes of length, then the header's opening brace.
    if start[8:] == b"{":
        return "a truncated or damaged file", f"copy it again, or {advice}"
    return f"a file that starts with {start[:8]!r}", f"name another, or {advice}"
