"""What the options of all verbs have in common: how they are parsed, shown and checked."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from avmsf.errors import AvmsfError

Flag = tyro.conf.FlagCreatePairsOff[bool]
"""An option that is off unless it is given."""
Unit = Literal["m", "cm", "mm", "in", "ft"]
_WIDEST = 129
"""Columns of help: in wider ones tyro sets its boxes side by side."""
T = TypeVar("T")


class InputError(AvmsfError):
    """An option names a file or folder that does not exist."""


@dataclass(frozen=True)
class Existing:
    """Marks a path that has to exist before a verb begins."""

    what: str


FieldFile = Annotated[
    Path, tyro.conf.arg(metavar="FIELD.safetensors"), Existing("a field file, as avmsf fit writes it")
]
CaptureFolder = Annotated[Path, tyro.conf.arg(metavar="CAPTURE"), Existing("a capture folder, with impacts.csv")]
SettingsFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml"), Existing("a capture.toml")]
OutputFolder = Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of all verbs."""

    quiet: Flag = False
    """Print only results, warnings and errors."""
    verbose: Flag = False
    """Print each step of the work as it begins."""

    def check_inputs(self) -> None:
        """Raise `InputError` for the first input that does not exist."""
        hints = get_type_hints(type(self), include_extras=True)
        for each in fields(self):
            expected = _expected(hints[each.name])
            value = getattr(self, each.name)
            if expected is None or value is None:
                continue
            for path in value if isinstance(value, tuple) else (value,):
                if not path.exists():
                    raise InputError.expected(
                        expected, got="no such file or folder", file=path, advice="check the name"
                    )


@dataclass(frozen=True, kw_only=True)
class Printing(Common):
    """Options of the verbs that print results."""

    json: Flag = False
    """Print the results as one JSON object to standard output, and everything else to standard error."""


def parse_options(
    kind: type[T], verb: str, words: Sequence[str], *, description: str | None = None, default: T | None = None
) -> T:
    """Return the options that the words spell; leaves by SystemExit for help and for what cannot be understood."""
    given: dict[str, Any] = {} if default is None else {"default": default}
    with one_column():
        return tyro.cli(
            kind, prog=f"avmsf {verb}", args=words, description=description, registry=REGISTRY, **given
        )  # fmt: skip


@contextmanager
def one_column() -> Iterator[None]:
    """Let help have one column of boxes, however wide the terminal is."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(min(_WIDEST, shutil.get_terminal_size().columns))
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


def _expected(hint: Any) -> str | None:
    """Return what a type's paths have to be; None where it has no such mark."""
    for each in getattr(hint, "__metadata__", ()):
        if isinstance(each, Existing):
            return each.what
    inner = get_args(hint)
    return next((found for each in inner if (found := _expected(each)) is not None), None)


def _optional(info: PrimitiveTypeInfo) -> Any:
    """Show `X | None` as X: that an option may be left out needs no word."""
    if get_origin(info.type) not in (Union, UnionType):
        return None
    kinds = [each for each in get_args(info.type) if each is not NoneType]
    if len(kinds) != 1 or len(get_args(info.type)) != 2:
        return None
    inner = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(inner, PrimitiveConstructorSpec):
        return inner

    def instance(words: list[str]) -> Any:
        return None if words == ["None"] else inner.instance_from_str(words)

    return PrimitiveConstructorSpec(
        nargs=inner.nargs,
        metavar=inner.metavar,
        instance_from_str=instance,
        is_instance=lambda value: value is None or inner.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else inner.str_from_instance(value),
        choices=inner.choices,
    )


REGISTRY = ConstructorRegistry()
"""How types are read and shown."""
REGISTRY.primitive_rule(_optional)
