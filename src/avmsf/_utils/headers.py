"""The header of a safetensors file, read without the library that reads its tensors, which takes seconds to load."""

import json
import struct
from pathlib import Path

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
