"""What the commands print: tables and text for people, JSON for programs, each on its own stream."""

import shlex
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from avmsf._utils.progress import ProgressDisplay
from avmsf._utils.text import json_text, printable
from avmsf.errors import AvmsfWarning


class _Console(ProgressDisplay):
    """What a verb prints: quiet, verbose or as JSON by the options of the verb that runs."""

    json = False
    """Whether the standard output is for one JSON object: results for people go to the standard error then."""


display = _Console()
say = display.say
note = display.note
doing = display.doing


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]], *, words: int = 1) -> str:
    """Return a table as text; its first `words` columns are words, set left, the others figures, set right."""
    cells = [list(map(str, row)) for row in (columns, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = (
        "  ".join(
            f"{cell:{'<' if place < words else '>'}{width}}"
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    )
    return "\n".join([title, *(f"  {line.rstrip()}" for line in lines)])


def decimals(value: float | int | None, places: int) -> str:
    """Return a number with so many decimals; a dash for None."""
    return "–" if value is None else f"{value:.{places}f}"


def command(words: str, path: Path, options: str = "") -> str:
    """Return a command on a path."""
    return f"{words} {shlex.quote(str(path))} {options}".rstrip()


def show(text: str) -> None:
    """Print a result for people."""
    display.close()
    print(printable(text), file=sys.stderr if display.json else sys.stdout, flush=True)


def print_json(values: Mapping[str, Any]) -> None:
    """With --json, print a verb's result to the standard output: what is not finite as null, what JSON has not as text.

    Without it, print nothing.
    """
    if display.json:
        display.close()
        print(printable(json_text(values, indent=2, default=str)), flush=True)


def finish(text: str, values: Mapping[str, Any], *steps: str, code: int = 0) -> int:
    """Print a verb's result, as text if there is any and with --json as values, and return its exit code.

    Last come the `steps` that are useful next, unless --quiet is given.
    """
    if text:
        show(text)
    print_json(values)
    for step in steps:
        say(f"next: {step}")
    return code


def show_plainly() -> None:
    """Let what a user should know appear once, as a sentence, without Python's file, line and category."""
    others, shown = warnings.showwarning, set[str]()

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, AvmsfWarning):
            others(message, category, *where, **more)
        elif str(message) not in shown:
            shown.add(str(message))
            print(f"note: {printable(str(message))}", file=sys.stderr)

    warnings.simplefilter("always", AvmsfWarning)
    warnings.showwarning = show
