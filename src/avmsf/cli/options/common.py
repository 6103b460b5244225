"""What the options of all verbs have in common: how they are parsed and checked."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeVar, get_type_hints

import tyro

from avmsf.cli.options.paths import InputError, path_mark
from avmsf.pipeline.config import PRESETS, Preset

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""An option that is off unless it is given."""
Unit = Literal["m", "cm", "mm", "in", "ft"]
_RENAMED = {"--at": "--position", "--picture": "--plots"}
"""Options of earlier versions, and what they are called now."""
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of all verbs."""

    quiet: Flag = False
    """Print only results, warnings and errors."""
    verbose: Flag = False
    """Print each step of the work as it begins."""

    @classmethod
    def parse(cls: type[T], words: Sequence[str]) -> T:
        """Return the options that the words spell, see `parse_options`; the module has the verb's name."""
        return parse_options(cls, cls.__module__.rpartition(".")[2], words)

    def check_inputs(self) -> None:
        """Raise for the first path that cannot be used, see `paths`, and for what a command's own checks find."""
        hints = get_type_hints(type(self), include_extras=True)
        for each in fields(self):
            mark = path_mark(hints[each.name])
            value = getattr(self, each.name)
            if mark is None or value is None:
                continue
            for path in value if isinstance(value, tuple) else (value,):
                mark.check(path)


@dataclass(frozen=True, kw_only=True)
class Printing(Common):
    """Options of the verbs that print results."""

    json: Flag = False
    """Print the results as one JSON object to standard output, and everything else to standard error."""


def parse_options(kind: Callable[..., T], verb: str, words: Sequence[str], *, default: T | None = None) -> T:
    """Return the options that the words spell; leaves by SystemExit for help and for what cannot be understood.

    `kind` is a dataclass, or a `functools.partial` of one, whose arguments are then the defaults. Raises `InputError`
    for an option that has another name now.
    """
    for word in words:
        if word in _RENAMED:
            raise InputError.expected(_RENAMED[word], got=word, name=word)
    given: dict[str, Any] = {} if default is None else {"default": default}
    return tyro.cli(kind, prog=f"avmsf {verb}", args=words, **given)


@dataclass(frozen=True)
class _Preset:
    preset: Preset = "default"


def preset_of(words: Sequence[str]) -> Preset:
    """Return the preset that the words name; it is read first, since it decides the defaults of all others."""
    chosen, _ = tyro.cli(_Preset, args=words, add_help=False, return_unknown_args=True)
    return chosen.preset


def preset_values(preset: Preset, **names: str) -> dict[str, Any]:
    """Return all settings of a preset, and its name, by the names of their options where these are others."""
    config = PRESETS[preset]
    values = {names.get(each.name, each.name): getattr(config, each.name) for each in fields(config)}
    return {**values, "preset": preset}


def option_of(name: str) -> str:
    """Return the option of a field without a prefix."""
    return f"--{name.replace('_', '-')}"
