"""Options whose defaults are a preset's: every setting of the pipeline, none by hand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, make_dataclass
from typing import Any, TypeVar, get_type_hints

import tyro

from avmsf.cli.options.helptext import one_column
from avmsf.config import PRESETS, Preset

T = TypeVar("T")


@dataclass(frozen=True)
class _Preset:
    preset: Preset = "default"


def preset_of(words: Sequence[str]) -> Preset:
    """Return the preset that the words name; it is read first, since it decides the defaults of all others."""
    with one_column():
        chosen, _ = tyro.cli(_Preset, args=words, add_help=False, return_unknown_args=True)
    return chosen.preset


def preset_values(preset: Preset, **names: str) -> dict[str, Any]:
    """Return all settings of a preset, and its name, by the names of their options where these are others."""
    config = PRESETS[preset]
    values = {names.get(each.name, each.name): getattr(config, each.name) for each in fields(config)}
    return {**values, "preset": preset}


def with_defaults(kind: type[T], values: Mapping[str, Any]) -> type[T]:
    """Return a kind of options with other defaults. Raises KeyError for a value that no option has."""
    hints = get_type_hints(kind, include_extras=True)
    own = [(name, hints[name], value) for name, value in values.items()]
    made: type[T] = make_dataclass(kind.__name__, own, bases=(kind,), frozen=True)
    return made
