"""Settings by name: `--set splat.steps=500`, or a file of them, which `--print-config` writes."""

import ast
import inspect
import json
import math
import textwrap
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro

from avmsf._utils.text import OTHER, as_type
from avmsf.cli.paths import Existing, InputError, arg

T = TypeVar("T")
Assignments = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg("NAME=VALUE", name="set")]
"""Settings, one for each time that the option is given."""
SettingsTable = Annotated[Path | None, arg("FILE"), Existing("settings, as --print-config writes them")]
_WIDTH = 100
"""Columns of the comments of a file of settings."""


def with_settings(
    config: T, assignments: Sequence[str], file: Path | None, options: Mapping[str, Any] = MappingProxyType({})
) -> T:
    """Return a configuration with the settings of a TOML file, and then those of the form NAME=VALUE and of options.

    A name is a path through the nested configurations, such as scene.splat.steps, or the end of one that has only one
    meaning, such as splat.steps. `options` have full names; None is one that was not given. Raises InputError for a
    name that is unknown or has several meanings, for a setting that is given as an option too, and for a value of
    another type, and what the configurations raise for values out of range.
    """
    known = {name: hint for name, hint, _, _ in nested_settings(config)}
    chosen = {name: value for name, value in options.items() if value is not None}
    given: dict[str, Any] = {}
    for source, values in ((file, _read(file)), (None, map(_assigned, assignments))):
        for name, value in values:
            full = _full_name(name, known, source)
            if source is None and full in chosen:
                advice = "leave one out"
                raise InputError.expected("the setting once", got="it as an option too", name=name, advice=advice)
            given[full] = _parsed(full, value, known[full])
    return _changed(config, given | chosen)


def as_toml(config: object) -> str:
    """Return a configuration as TOML, with the meaning of each setting as a comment; None is the text "null"."""
    lines: list[str] = []
    section = ""
    for name, _, value, meaning in sorted(nested_settings(config), key=lambda each: each[0].count(".") > 0):
        owner, _, last = name.rpartition(".")
        if owner != section:
            lines += ["", f"[{owner}]"]
            section = owner
        lines += textwrap.wrap(" ".join(meaning.split()), _WIDTH, initial_indent="# ", subsequent_indent="# ")
        infinite = isinstance(value, float) and not math.isfinite(value)
        text = str(value) if infinite else json.dumps("null" if value is None else value, default=str)
        lines.append(f"{last} = {text}")
    return "\n".join(lines)


def nested_settings(config: object, owner: str = "") -> Iterator[tuple[str, Any, Any, str]]:
    """Yield the name of each setting of nested configurations, its type, its value and its meaning."""
    hints, meanings = get_type_hints(type(config)), _meanings(type(config))
    for each in fields(config):  # type: ignore[arg-type]
        value = getattr(config, each.name)
        if is_dataclass(value):
            yield from nested_settings(value, f"{owner}{each.name}.")
        else:
            yield owner + each.name, hints[each.name], value, meanings.get(each.name, "")


def _meanings(kind: type) -> dict[str, str]:
    """Return the docstring below each field of a dataclass."""
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for field, below in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            found[ast.unparse(field.target)] = str(below.value.value)
    return found


def _read(file: Path | None) -> list[tuple[str, Any]]:
    """Return the settings of a TOML file, by dotted names. Raises InputError for a file that is no TOML."""
    if file is None:
        return []
    try:
        return list(_flat(tomllib.loads(file.read_text(encoding="utf-8"))))
    except (OSError, ValueError) as error:
        raise InputError.expected("settings as TOML", got=str(error), file=file, advice="correct the line") from error


def _flat(table: Mapping[str, Any], owner: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{owner}{name}.")
        else:
            yield owner + name, value


def _assigned(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError.expected("NAME=VALUE, such as splat.steps=500", text, name="--set")
    return name.strip().replace("-", "_"), value.strip()


def _full_name(name: str, known: Mapping[str, Any], file: Path | None) -> str:
    """Return the full name of the setting that a name means."""
    meant = [each for each in known if each == name] or [each for each in known if each.endswith(f".{name}")]
    if len(meant) == 1:
        return meant[0]
    if meant:
        wanted, advice = (
            "the name of one setting",
            f"write {' or '.join(each.removeprefix('scene.') for each in meant)}",
        )
    else:
        near = get_close_matches(name, [*known, *(each.removeprefix("scene.") for each in known)], n=1, cutoff=0.5)
        advice = "; ".join([*(f"did you mean {each}?" for each in near), "--print-config lists all"])
        wanted = "the name of a setting"
    raise InputError.expected(wanted, name, file=file, name="--set", advice=advice)


def _parsed(name: str, value: Any, hint: Any) -> Any:
    """Return a value, or what a text spells, as a type; several numbers are separated by commas. Raises InputError."""
    for candidate in _readings(value) if isinstance(value, str) else [value]:
        found = as_type(candidate, hint)
        if found is not OTHER:
            return found
    kind = hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")
    raise InputError.expected(f"a value of the type {kind}", value, name=name.removeprefix("scene."))


def _readings(text: str) -> Iterator[Any]:
    """Yield what a text may mean: a number, true, false or null, a list of these, or the text itself."""
    if text == "None":
        yield None
    for words in (text, f"[{text}]"):
        with suppress(ValueError):
            yield json.loads(words)
    yield text


def _changed(config: T, given: Mapping[str, Any], owner: str = "") -> T:
    """Return nested configurations with the values that are given by full names."""
    changes: dict[str, Any] = {}
    for each in fields(config):  # type: ignore[arg-type]
        name, value = owner + each.name, getattr(config, each.name)
        if name in given:
            changes[each.name] = given[name]
        elif is_dataclass(value) and any(other.startswith(f"{name}.") for other in given):
            changes[each.name] = _changed(value, given, f"{name}.")
    return replace(config, **changes) if changes else config  # type: ignore[type-var]
