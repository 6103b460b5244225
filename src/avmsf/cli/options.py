"""What the options of verbs have in common: how they are parsed and checked, before what computes is loaded."""

import io
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_type_hints

import tyro

from avmsf.capture.issues import Issues
from avmsf.capture.settings import settings_of
from avmsf.capture.table import present_impacts, read_impacts
from avmsf.cli.paths import Existing, InputError, New, arg, path_mark
from avmsf.cli.settings import Assignments, SettingsTable, as_toml, nested_settings

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
        """Return the options that the words spell, see `parse_options`; the module has the verb's name."""
        return parse_options(cls, cls.__module__.rpartition(".")[2], words)

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


def parse_options(kind: type[T], verb: str, words: Sequence[str], default: T | None = None) -> T:
    """Return the options that the words spell; leaves by SystemExit for help.

    Raises `InputError` for what cannot be understood.
    """
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
        advice = "separate numbers by blanks" if commas else f"`avmsf {verb} --help` lists the options"
        words_of_tyro = " ".join(_BORDERS.sub(" ", found).split()).rstrip(".")
        raise InputError(f"{words_of_tyro}; {advice}", name=verb) from None


@dataclass(frozen=True, kw_only=True)
class Configured(Common, ABC):
    """Options of the verbs that have more settings than options."""

    set: Assignments = ()
    """Change a setting, such as splat.steps=500; repeatable."""
    config: SettingsTable = None
    """Take settings from a file; options come after it."""
    print_config: Flag = False
    """Print all settings as such a file, and stop."""
    usual: ClassVar[object]
    """The settings where nothing changes them."""
    resumes: ClassVar[bool] = True

    @property
    @abstractmethod
    def all_settings(self) -> object:
        """The settings by the options."""

    @classmethod
    def parse(cls: type[S], words: Sequence[str]) -> S:
        """Return the options that the words spell; with --print-config print the settings and leave by SystemExit.

        Raises `InputError` also for a setting that is written as an option.
        """
        own = {each.name for each in fields(cls)}
        for word in words:
            name = word.partition("=")[0].replace("-", "_").lstrip("_")
            if not word.startswith("--") or name in own:
                continue
            meant = [full for full, *_ in nested_settings(cls.usual) if f".{full}".endswith(f".{name}")]
            if meant:
                forms = " or ".join(f"--set {full.removeprefix('scene.')}=VALUE" for full in meant)
                raise InputError.expected(forms, got=word, name=word)
        if "--print-config" not in words:
            return super().parse(words)
        # What has no default is not read.
        hints = get_type_hints(cls)
        needed: dict[str, Any] = {
            each.name: {str: each.name, Path: Path(each.name)}.get(hints[each.name], (Path(each.name),))
            for each in fields(cls)
            if each.default is MISSING and each.default_factory is MISSING
        }
        verb = cls.__module__.rpartition(".")[2]
        print(as_toml(parse_options(cls, verb, words, default=cls(**needed)).all_settings))
        raise SystemExit(0)


def option_of(name: str) -> str:
    """Return the option of a field without a prefix."""
    return f"--{name.replace('_', '-')}"


def expect_capture(folder: Path) -> None:
    """Raise `CaptureError` where a capture folder's settings or its table cannot be used."""
    present_impacts(folder, read_impacts(folder, settings_of(folder), Issues()), Issues())
