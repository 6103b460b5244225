"""Values of a file's JSON as what they were before: each of its type, none missing, none unknown."""

import sys
from dataclasses import fields
from typing import Any, TypeVar

from avmsf.errors import AvmsfError

_Record = TypeVar("_Record")


class RecordError(AvmsfError, ValueError):
    """A value of a file's record is missing, unknown or of another type or size: `name` is its key."""


def record_of(example: _Record, values: Any, name: str) -> _Record:
    """Return a record of settings from a dict of exactly the example's fields, each of the type that it has there.

    `example` is a dataclass's instance; `name` is what errors call the record. Raises RecordError for fields that are
    missing or unknown or of another type, and for what is not a dict.
    """
    like(values, {}, name)
    examples = {each.name: getattr(example, each.name) for each in fields(example)}  # type: ignore[arg-type]
    if values.keys() != examples.keys():
        differing = sorted(values.keys() ^ examples.keys())
        raise RecordError(
            f"{name}: expected exactly its own keys; missing or unknown: {', '.join(differing)}",
            name=f"{name}.{differing[0]}",
            value=values.get(differing[0]),
        )
    return type(example)(**{each: like(value, examples[each], f"{name}.{each}") for each, value in values.items()})


def like(value: Any, example: Any, name: str) -> Any:
    """Return a JSON value as the type of `example`. Raises RecordError where it is of another."""
    if isinstance(example, tuple) and isinstance(value, list):
        return tuple(like(each, example[0], name) for each in value)
    if isinstance(example, float) and type(value) is int and abs(value) <= sys.float_info.max:
        return float(value)
    if type(value) is not type(example):
        raise RecordError(f"{name}: expected {type(example).__name__}, got {value!r}", name=name, value=value)
    return value


def count_of(value: Any, name: str, *, least: int = 1) -> int:
    """Return a whole number of `least` or more. Raises RecordError for other values."""
    if like(value, 1, name) < least:
        raise RecordError(f"{name}: expected {least} or more, got {value}", name=name, value=value)
    return int(value)
