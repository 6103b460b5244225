"""How help shows options: sentences that fill the lines, plain names of values, defaults only where they say something.

tyro reads a dataclass by these rules in place of its own. Its help is printed with other titles of groups, in one
column of boxes and with filled paragraphs. tyro (1.0.17) has no option or theme for these: `one_column` edits the text.
"""

import ast
import functools
import inspect
import io
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import StructConstructorSpec, StructFieldSpec, StructTypeInfo

from avmsf.cli.options.usage import UsageExit, usage_error

_WIDEST = 129
"""Columns of help: in wider ones tyro sets its boxes side by side."""
_BOX = re.compile(r"[│╭╰]|^ [\w-]+ options *$")
"""Lines that tyro has filled, and titles where the output cannot have boxes."""
_TITLE = re.compile(r"(?<=[ m])([A-Za-z][\w-]*)((?:\x1b\[[\d;]*m)*) options(?=.*╮| *$)")
"""The title that tyro gives to a group of options; on a terminal, its words have colors."""
_TITLES = {"splat": "Gaussians", "lift": "features", "body": "bodies", "guided-edit": "guided edits"}
"""What groups of options set, where it is not what their prefix says."""
_HELP_OF_TYRO, _HELP = "show this help message and exit", "Show this help and exit."
"""What tyro says of --help, and what it is to say, as the other options do."""
_NAMES: dict[object, str] = {int: "N", float: "NUMBER", str: "TEXT", Path: "FILE"}


class _Page(io.StringIO):
    """Help, or an error, on its way to a terminal or to a file, which has no colors."""

    def __init__(self, stream: Any) -> None:
        super().__init__()
        self.stream = stream

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """How its text is encoded, which decides what boxes are drawn with: tyro knows utf-8 in lower case alone."""
        return (self.stream.encoding or "").lower()

    def isatty(self) -> bool:
        """Return whether it goes to a terminal."""
        return self.stream.isatty()


def paragraphs(text: str) -> str:
    """Return a docstring with a line for each paragraph."""
    return "\n\n".join(" ".join(part.split()) for part in inspect.cleandoc(text).split("\n\n"))


@contextmanager
def one_column() -> Iterator[None]:
    """Let help have one column of boxes, however wide the terminal is, below text that fills the lines.

    Raises `UsageExit` where the block leaves with an error.
    """
    width = min(_WIDEST, shutil.get_terminal_size().columns)
    before, page, errors = os.environ.get("COLUMNS"), _Page(sys.stdout), _Page(sys.stderr)
    os.environ["COLUMNS"] = str(width)
    try:
        with redirect_stdout(page), redirect_stderr(errors):
            yield
    except SystemExit as ending:
        if ending.code:
            raise UsageExit(usage_error(errors.getvalue())) from None
        raise
    finally:
        print(errors.getvalue(), end="", file=sys.stderr)
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before
        text = page.getvalue().replace(_HELP_OF_TYRO, _HELP.ljust(len(_HELP_OF_TYRO)))
        for line in re.sub(r"\n{3,}", "\n\n", text).splitlines():
            print(_with_title(line.rstrip()) if _BOX.search(line) else textwrap.fill(line, width))


def _with_title(line: str) -> str:
    """Return a line of a box, in which the title of a group of options is the noun for what they set."""
    found = _TITLE.search(line)
    if found is None:
        return line
    title = _TITLES.get(found[1], found[1].replace("-", " "))
    filled = "─" * (len(f"{found[1]} options") - len(title))
    return line.replace(found[0], title + found[2], 1).replace("╮", f"{filled}╮")


def described_fields(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Return how one of our dataclasses is made of options; None for other types."""
    if not any(map(_is_ours, getattr(info.type, "__mro__", ()))):
        return None
    hints = get_type_hints(info.type, include_extras=True)
    specs = tuple(_spec(info, each, hints[each.name]) for each in fields(info.type) if each.init)
    return StructConstructorSpec(info.type, specs)


def _is_ours(kind: type) -> bool:
    return is_dataclass(kind) and kind.__module__.startswith("avmsf.")


def _spec(info: StructTypeInfo, each: "Field[Any]", hint: Any) -> StructFieldSpec:
    if is_dataclass(info.default) and hasattr(info.default, each.name):
        default = getattr(info.default, each.name)
    elif each.default is not MISSING:
        default = each.default
    else:
        default = tyro.MISSING if each.default_factory is MISSING else each.default_factory()
    shown = functools.partial(_sentence, info.type, each.name)
    return StructFieldSpec(each.name, _with_names(each, hint), default, shown)


def option_of(each: "Field[Any]") -> str:
    """Return the option of a field without a prefix."""
    return f"--{each.name.replace('_', '-')}"


def _with_names(each: "Field[Any]", hint: Any) -> Any:
    """Return a type with what its values are called and how its default is shown; its own marks come first."""
    kind, marks = (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())
    if is_dataclass(kind):
        return hint
    repeated, flag = tyro.conf.UseAppendAction in marks, tyro.conf.FlagCreatePairsOff in marks
    shown: Callable[[str], str] | None = _on_or_off if kind is bool and not flag else _default
    own = tyro.conf.arg(
        metavar=each.metadata.get("metavar") or (None if kind is bool else _metavar(kind)),
        help_behavior_hint=None if repeated else shown,
    )
    return Annotated[(kind, own, *marks)]


def _metavar(kind: Any) -> str | None:
    """Return what the values of a type are called; None leaves it to tyro, which lists the words of a choice."""
    values = [each for each in get_args(kind) if each is not NoneType]
    if get_origin(kind) in (Union, UnionType):
        return _metavar(values[0]) if len(values) == 1 else None
    if get_origin(kind) is tuple and Ellipsis in values:
        return f"{_metavar(values[0])} ..."
    if kind == tuple[float, float, float]:
        return "X Y Z"
    return None if get_origin(kind) is Literal else _NAMES.get(kind)


def _default(label: str) -> str:
    """Return what help says of a default: nothing where it is to do without."""
    if label in ("", "None", "False"):
        return ""
    return f"(default: {float(label):g})" if re.fullmatch(r"-?\d+\.\d*(e[+-]?\d+)?", label) else f"(default: {label})"


def _on_or_off(label: str) -> str:
    return "(default: on)" if label == "True" else "(default: off)"


def _sentence(kind: type, name: str) -> str | None:
    """Return a field's docstring in one line, of the class that states it."""
    found = (_docstrings(each).get(name) for each in kind.__mro__ if _is_ours(each))
    return next((each for each in found if each is not None), None)


@functools.cache
def _docstrings(kind: type) -> dict[str, str]:
    """Return the text below each of a class's own fields."""
    [node] = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(node, ast.ClassDef)
    found = {}
    for line, below in zip(node.body, node.body[1:], strict=False):
        if isinstance(line, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            assert isinstance(line.target, ast.Name)
            # Further paragraphs hold sources and reasons.
            found[line.target.id] = " ".join(str(below.value.value).split("\n\n")[0].split())
    return found
