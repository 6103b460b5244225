"""What the options of all verbs have in common: how they are parsed and checked."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, Self, TypeVar, get_type_hints

import tyro

from avmsf.cli.options.paths import InputError, path_mark
from avmsf.cli.options.settings import Assignments, SettingsTable, as_toml, with_settings
from avmsf.pipeline.config import PRESETS, PipelineConfig, Preset

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""An option that is off unless it is given."""
Unit = Literal["m", "cm", "mm", "in", "ft"]
_RENAMED = {"--at": "--position", "--picture": "--plots"}
"""Options of earlier versions, and what they are called now."""
_SECTIONS = ("--views.", "--splat.", "--lift.", "--body.", "--fit.", "--hammer.", "--imperfections.")
"""Beginnings of options of earlier versions that are settings now."""
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of all verbs."""

    quiet: Flag = False
    """Print only results, warnings and errors."""
    verbose: Flag = False
    """Print each step of the work as it begins."""

    @classmethod
    def parse(cls, words: Sequence[str]) -> Self:
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


def parse_options(kind: type[T], verb: str, words: Sequence[str]) -> T:
    """Return the options that the words spell; leaves by SystemExit for help and for what cannot be understood.

    Raises `InputError` for an option that has another name now.
    """
    for word in words:
        if word in _RENAMED:
            raise InputError.expected(_RENAMED[word], got=word, name=word)
        if word.startswith(_SECTIONS):
            setting = word[2:].partition("=")[0].replace("-", "_")
            raise InputError.expected(f"--set {setting}=VALUE", got=word, name=word)
    return tyro.cli(kind, prog=f"avmsf {verb}", args=words)


@dataclass(frozen=True, kw_only=True)
class Configured(Printing):
    """Options of the verbs that have more settings than options."""

    set: Assignments = ()
    """Change a setting, such as splat.steps=500; once per setting."""
    config: SettingsTable = None
    """Take settings from this file; --set comes after it."""
    print_config: Flag = False
    """Print all settings, with what they mean, as a file for --config, and do nothing else."""

    @classmethod
    def parse(cls, words: Sequence[str]) -> Self:
        """Return the options that the words spell; with --print-config print the settings and leave by SystemExit."""
        if "--print-config" in words:
            print(as_toml(cls.settings_named(words)))
            raise SystemExit(0)
        return super().parse(words)

    @classmethod
    def settings_named(cls, words: Sequence[str]) -> object:
        """Return the settings that the words spell, of which other options are not read."""
        chosen, _ = tyro.cli(Configured, args=words, add_help=False, return_unknown_args=True)
        return with_settings(cls.default_settings(words), chosen.set, chosen.config)

    @classmethod
    def default_settings(cls, words: Sequence[str]) -> object:
        """Return the settings that hold where the words change none."""
        raise NotImplementedError


@dataclass(frozen=True)
class _Preset:
    preset: Preset = "default"


def preset_of(words: Sequence[str]) -> PipelineConfig:
    """Return the settings of the preset that the words name."""
    chosen, _ = tyro.cli(_Preset, args=words, add_help=False, return_unknown_args=True)
    return PRESETS[chosen.preset]


def option_of(name: str) -> str:
    """Return the option of a field without a prefix."""
    return f"--{name.replace('_', '-')}"
