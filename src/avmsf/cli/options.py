"""What the options of verbs have in common: how they are parsed and checked, before what computes is loaded.

And settings by name: `--set splat.steps=500`, or a file of them, which `--print-config` writes.
"""

import ast
import inspect
import io
import json
import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stderr, suppress
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_type_hints

import tyro

from avmsf._utils.text import OTHER, as_type, flat, read_toml, words_of
from avmsf.capture.issues import Issues
from avmsf.capture.settings import settings_of
from avmsf.capture.table import present_impacts, read_impacts
from avmsf.cli.paths import Existing, InputError, New, arg, path_mark

Flag = Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(help_behavior_hint="")]
"""An option that is off unless it is given."""
Int = Annotated[int | None, arg("INT")]
Number = Annotated[float | None, arg("FLOAT")]
Name = Annotated[str | None, arg("NAME")]
"""Options that may be left out."""
Device = Annotated[str | None, arg("cpu|cuda")]
Unit = Literal["m", "cm", "mm", "in", "ft"]
_BORDERS = re.compile(r"[─│╭╮╰╯|+]|-{3,}")
"""What tyro draws around a message."""
_COMMENT_COLUMNS = 100
"""Of the comments of a file of settings."""
_MORE = re.compile(r"Argument helptext:|For full helptext|Got errors:")
"""What follows a message of tyro's in its box."""
T = TypeVar("T")
# Not Self, which run-time checks of types cannot read in a dataclass.
C = TypeVar("C", bound="Common")
S = TypeVar("S", bound="Configured")


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of all verbs."""

    only_results: Annotated[Flag, tyro.conf.arg(name="quiet")] = False
    """Print only results, warnings and errors."""
    verbose: Flag = False
    """Print each step of the work as it begins."""
    json: Flag = False
    """Print the results as one JSON object."""
    resumes: ClassVar[bool] = False
    """Whether an interrupted command goes on from where it was when it is repeated."""

    @classmethod
    def parse(cls: type[C], words: Sequence[str]) -> C:
        """Return the options that the words spell, see `parse_options`."""
        return parse_options(cls, words)

    def check_inputs(self) -> None:
        """Raise the package's errors for paths and other options that cannot be used, before torch is loaded."""
        self.check_paths()
        self._check()

    def check_paths(self) -> None:
        """Raise for the first path that cannot be used."""
        for _, mark, paths in self.marked_paths():
            for path in paths:
                mark.check(path)

    def marked_paths(self) -> Iterator[tuple[str, Existing | New, tuple[Path, ...]]]:
        """Yield each option whose values are paths: its name, what they have to be, and the paths that are given."""
        hints = get_type_hints(type(self), include_extras=True)
        for each in fields(self):
            mark, value = path_mark(hints[each.name]), getattr(self, each.name)
            if mark is not None:
                yield each.name, mark, value if isinstance(value, tuple) else () if value is None else (value,)

    def _check(self) -> None:
        """Raise for other options that cannot be used."""


def parse_options(kind: type[T], words: Sequence[str], default: T | None = None) -> T:
    """Return the options that the words spell; leaves by SystemExit for help. The module of `kind` has the verb's name.

    Raises `InputError` for what cannot be understood.
    """
    verb = kind.__module__.rpartition(".")[2]
    given: dict[str, Any] = {} if default is None else {"default": default}
    try:
        with redirect_stderr(io.StringIO()) as box:
            # A help is of all arguments, also of those that stand before it.
            args = ["--help"] if {"-h", "--help"} & {*words} else words
            return tyro.cli(kind, prog=f"avmsf {verb}", args=args, **given)
    except SystemExit as ending:
        if not ending.code:
            raise
        # The first line of the box is its title.
        found = _MORE.split(box.getvalue().strip().partition("\n")[2])[0]
        commas = any(re.fullmatch(r"-?[\d.]+(,-?[\d.]+)+", word) for word in words)
        advice = "separate numbers by blanks (0.5, not 0,5)" if commas else f"`avmsf {verb} --help` lists the options"
        advice += ", --print-config what --set changes" * (issubclass(kind, Configured) and not commas)
        words_of_tyro = " ".join(_BORDERS.sub(" ", found).split()).rstrip(".")
        raise InputError(f"{words_of_tyro}; {advice}", name=verb) from None


@dataclass(frozen=True, kw_only=True)
class Configured(Common):
    """Options of the verbs that have more settings than options."""

    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], arg("NAME=VALUE", name="set")] = ()
    """Change a setting, such as splat.steps=500; repeatable."""
    config: Annotated[Path | None, arg("FILE"), Existing("settings, as --print-config writes them")] = None
    """Take settings from a file; options come after it."""
    print_config: Flag = False
    """Print all settings as such a file, and stop."""
    usual: ClassVar[Any]
    """The settings where nothing changes them."""
    resumes: ClassVar[bool] = True

    @cached_property
    def all_settings(self) -> Any:
        """The settings by the options."""
        return with_settings(self.usual, self.set, self.config)

    @classmethod
    def parse(cls: type[S], words: Sequence[str]) -> S:
        """Return the options that the words spell; with --print-config print the settings and leave by SystemExit."""
        if "--print-config" not in words:
            return super().parse(words)
        # What has no default is not read.
        hints = get_type_hints(cls)
        needed: dict[str, Any] = {
            each.name: {str: each.name, Path: Path(each.name)}.get(hints[each.name], (Path(each.name),))
            for each in fields(cls)
            if each.default is MISSING and each.default_factory is MISSING
        }
        print(as_toml(parse_options(cls, words, default=cls(**needed)).all_settings))
        raise SystemExit(0)


def option_of(name: str) -> str:
    """Return the option of a field without a prefix."""
    return f"--{name.replace('_', '-')}"


def expect_capture(folder: Path) -> None:
    """Raise `CaptureError` where a capture folder's settings or its table cannot be used."""
    present_impacts(folder, read_impacts(folder, settings_of(folder), Issues()), Issues())


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
        lines += textwrap.wrap(" ".join(meaning.split()), _COMMENT_COLUMNS, initial_indent="# ", subsequent_indent="# ")
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
        return list(flat(read_toml(file)))
    except (OSError, ValueError) as error:
        raise InputError.expected("settings as TOML", got=str(error), file=file, advice="correct the line") from error


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
    raise InputError.expected(words_of(hint), value, name=name.removeprefix("scene."))


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
