"""Values out of a file's JSON as what they were before: each of its type, all of them there, none besides."""

import sys
from dataclasses import fields
from typing import Any, TypeVar

_Record = TypeVar("_Record")


def record_of(example: _Record, values: Any, name: str) -> _Record:
    """Return a record of settings from a dict of exactly the example's fields, each of the type that it has there.

    `example` is a dataclass's instance; `name` is what errors call the record. Raises ValueError for fields that are
    missing or unknown, TypeError for one of another type and for what is no dict.
    """
    like(values, {}, name)
    examples = {each.name: getattr(example, each.name) for each in fields(example)}  # type: ignore[arg-type]
    if values.keys() != examples.keys():
        differing = ", ".join(sorted(values.keys() ^ examples.keys()))
        raise ValueError(f"{name}: missing or unknown {differing}")
    return type(example)(**{each: like(value, examples[each], f"{name}.{each}") for each, value in values.items()})


def like(value: Any, example: Any, name: str) -> Any:
    """Return a JSON value as the type of `example`. Raises TypeError where it is of another."""
    if isinstance(example, tuple) and isinstance(value, list):
        return tuple(like(each, example[0], name) for each in value)
    if isinstance(example, float) and type(value) is int and abs(value) <= sys.float_info.max:
        return float(value)
    if type(value) is not type(example):
        raise TypeError(f"{name}: expected {type(example).__name__}, got {value!r}")
    return value


def count_of(value: Any, name: str, *, least: int = 1) -> int:
    """Return a whole number of `least` or more. Raises TypeError or ValueError for what is none."""
    if like(value, 1, name) < least:
        raise ValueError(f"{name}: expected {least} or more, got {value}")
    return int(value)
