"""Text: words for messages, and text, JSON and TOML that others wrote, bounded in size and depth, with their values.

What reads raises `OSError` where the file cannot be read and `ValueError` for contents that cannot be used, so that
each reader gives its own error with the file's name.
"""

import csv
import io
import json
import math
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from avmsf.errors import AvmsfError

MAX_TEXT_BYTES = 16 << 20
"""Largest table or JSON that is read: 25,000 frames of a transforms.json, or 200,000 rows of a table of contacts.
JSON of this length takes at most about 0.5 GB as Python objects."""
MAX_TOML_BYTES = 16 << 10
"""Largest TOML file that is read: four times all settings of a capture with a comment each. Python's reader takes time
and memory that grow with the square of a dotted key's length: 1 s and 0.3 GB for one of this length."""
_HIDDEN = [*range(0x20), 0x7F, *range(0x80, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)]
"""Control characters of terminals (C0, DEL, C1), and those that reverse the direction of what follows."""
_ESCAPES = {code: chr(code).encode("unicode_escape").decode() for code in _HIDDEN if chr(code) not in "\n\t"}
_Record = TypeVar("_Record")
OTHER: Any = object()
"""Stands for a value of another type."""


def printable(text: str) -> str:
    """Return text with control characters, except line feeds and tabs, as escape sequences that a terminal shows."""
    return text.translate(_ESCAPES)


def counted(number: int, thing: str) -> str:
    """Return a number with its noun, whose plural ends in s: "1 file", "2 files"."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def format_number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash for None and for what is not finite."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0 or not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}" if value else "0"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def json_text(values: Any, *, indent: int, default: type[str] | None = None) -> str:
    """Return values as JSON: what is not finite as null, and what JSON has not by `default`, or as a TypeError."""
    return json.dumps(_finite(values), indent=indent, ensure_ascii=False, allow_nan=False, default=default)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows of cells as CSV, each ended by a line feed."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def listed(names: Sequence[str], *, most: int = 5, separator: str = ", ") -> str:
    """Return the first names or sentences and how many more there are."""
    more = len(names) - most
    return separator.join(names[:most]) + (f" and {more} more" if more > 0 else "")


def in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return names in natural order: numbers within them by value, 2 before 10, and before letters."""
    return tuple(sorted(names, key=lambda name: (re.sub(r"\d+", lambda digits: digits[0].zfill(255), name), name)))


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


def read_json_object(
    path: Path, *, raising: type[AvmsfError], advice: str = "copy or export it again", max_bytes: int = MAX_TEXT_BYTES
) -> dict[str, Any]:
    """Return the object that a JSON file holds; raises `raising` where it cannot be read or holds something else."""
    try:
        record = read_json(path, max_bytes=max_bytes)
    except (OSError, ValueError) as error:
        raise raising.expected("a JSON file", got=str(error), file=path, advice=advice) from error
    if not isinstance(record, dict):
        raise raising.expected("a JSON object", type(record).__name__, file=path, advice=advice)
    return record


def read_toml(path: Path) -> dict[str, Any]:
    """Return the table of a TOML file."""
    text = read_text(path, max_bytes=MAX_TOML_BYTES)
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("expected a few levels of tables, got hundreds") from error


def flat(table: Mapping[str, Any], owner: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables by dotted names, such as `outer.inner`, after the `owner`'s name and dot."""
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{owner}{name}.")
        else:
            yield owner + name, value


class RecordError(AvmsfError, ValueError):
    """A value of a file's record is missing, unknown or of another type or size: `name` is its key."""


def record_of(
    kind: type[_Record], values: Any, name: str = "", *, added: Mapping[str, Any] = MappingProxyType({})
) -> _Record:
    """Return a dataclass's record from a dict of exactly its fields, each of its type.

    `name` is what errors call the record; `added` are the values of fields that may be missing. Raises RecordError for
    other fields that are missing, for fields that are unknown or of another type, and for what is not a dict.
    """
    hints, owner = get_type_hints(kind), f"{name}." if name else ""
    values = {each: value for each, value in added.items() if each in hints} | like(values, {}, name)
    for each in sorted(values.keys() ^ hints.keys()):
        if each in hints:
            raise RecordError.expected(words_of(hints[each]), name=f"{owner}{each}")
        raise RecordError.unknown(each, hints, name=f"{owner}{each}")
    return kind(**{each: typed(value, hints[each], f"{owner}{each}") for each, value in values.items()})


def without_defaults(values: Mapping[str, Any], added: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record's values for a file, which `record_of` reads: those of `added` fields only where they differ."""
    return {name: value for name, value in values.items() if name not in added or value != added[name]}


def as_type(value: Any, hint: Any) -> Any:
    """Return a plain value as a type, or `OTHER` where it is none of that type."""
    kind, arguments = get_origin(hint), get_args(hint)
    if kind in (Union, UnionType):
        return next((each for part in arguments if (each := as_type(value, part)) is not OTHER), OTHER)
    if kind is Literal:
        return value if value in arguments else OTHER
    if kind is tuple and isinstance(value, list | tuple):
        parts = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        found = tuple(map(as_type, value, parts)) if len(parts) == len(value) else (OTHER,)
        return OTHER if OTHER in found else found
    if hint is float and type(value) is int and abs(value) <= sys.float_info.max:
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    return value if isinstance(hint, type) and type(value) is hint else OTHER


def typed(value: Any, hint: Any, name: str) -> Any:
    """Return a JSON value as a type. Raises RecordError where it is of another."""
    found = as_type(value, hint)
    if found is OTHER:
        raise RecordError.expected(words_of(hint), value, got=repr(value), name=name)
    return found


def words_of(hint: Any) -> str:
    """Return in plain words what is of a type."""
    kind, parts = get_origin(hint), get_args(hint)
    if kind is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if kind is tuple:
        return f"[{', '.join('...' if each is Ellipsis else words_of(each) for each in parts)}]"
    if kind in (Union, UnionType):
        return " or ".join("none" if each is type(None) else words_of(each) for each in parts)
    words = {str: "text", int: "a whole number", float: "a number", bool: "true or false", dict: "an object"}
    return words[hint] if hint in words else getattr(hint, "__name__", str(hint))


def like(value: Any, example: Any, name: str) -> Any:
    """Return a JSON value as the type of `example`. Raises RecordError where it is of another."""
    return typed(value, type(example), name)


def count_of(value: Any, name: str, *, least: int = 1) -> int:
    """Return a whole number of `least` or more. Raises RecordError for other values."""
    if like(value, 1, name) < least:
        raise RecordError.expected(f"{least} or more", value, name=name)
    return int(value)
