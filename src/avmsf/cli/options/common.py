"""What the options of all verbs have in common: how they are parsed, shown and checked."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from avmsf.cli.options.helptext import described_fields, one_column, paragraphs
from avmsf.cli.options.paths import InputError, path_mark

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

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


def parse_options(
    kind: type[T], verb: str, words: Sequence[str], *, description: str | None = None, default: T | None = None
) -> T:
    """Return the options that the words spell; leaves by SystemExit for help and for what cannot be understood.

    The latter is a `UsageExit`. Raises `InputError` for an option that has another name now.
    """
    for word in words:
        if word in _RENAMED:
            raise InputError.expected(_RENAMED[word], got=word, name=word)
    given: dict[str, Any] = {} if default is None else {"default": default}
    with one_column():
        return tyro.cli(
            kind, prog=f"avmsf {verb}", args=words, description=paragraphs(description or kind.__doc__ or ""),
            registry=REGISTRY, **given,
        )  # fmt: skip


def spelled(options: object, *, without: Collection[str] = (), prefix: str = "") -> dict[str, str]:
    """Return how the command line spells options, by their names; those that nothing was given for are left out.

    `without` are the fields that do not count.
    """
    words: dict[str, str] = {}
    for each in fields(cast("DataclassInstance", options)):
        if each.name in without:
            continue
        value, name = getattr(options, each.name), prefix + each.name.replace("_", "-")
        if is_dataclass(value):
            words |= spelled(value, prefix=f"{name}.")
        elif isinstance(value, bool):
            # A flag has no form for off; a setting within a group has one.
            off = f"--{prefix}no-{name.removeprefix(prefix)}" if prefix else None
            words |= {f"--{name}": f"--{name}"} if value else {f"--{name}": off} if off else {}
        elif value is not None and value != ():
            several = value if isinstance(value, tuple) else (value,)
            text = " ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in several)
            words[f"--{name}"] = f"--{name} {text}"
    return words


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


class _Words(tuple[str, ...]):
    """The words of a choice, as an error lists them."""

    def __str__(self) -> str:
        return ", ".join(self)


def _choice(info: PrimitiveTypeInfo) -> Any:
    """Read one of several words; an error lists them as words."""
    if get_origin(info.type) is not Literal:
        return None
    values = {str(each): each for each in get_args(info.type)}
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f"{{{','.join(values)}}}",
        instance_from_str=lambda words: values[words[0]],
        is_instance=lambda value: value in values.values(),
        str_from_instance=lambda value: [str(value)],
        choices=_Words(values),
    )


REGISTRY = ConstructorRegistry()
"""How types are read and shown."""
REGISTRY.primitive_rule(_choice)
REGISTRY.primitive_rule(_optional)
REGISTRY.struct_rule(described_fields)
