"""What the commands print: tables and text for people, JSON for programs, each on its own stream."""

import json
import math
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from avmsf._utils.text import printable
from avmsf.cli.progress import display, say

if TYPE_CHECKING:
    from rich.console import Console


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 1) -> str:
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


_absent: set[Path] = set()
"""Folders of outputs that were not there when the verb began, and have not been printed since."""


@contextmanager
def announcing_folders(folders: Iterable[Path]) -> Iterator[None]:
    """Print which of these folders the block has created: before what is useful next, or at its end."""
    _absent.update(folder for folder in folders if not folder.exists())
    try:
        yield
        _say_created()
    finally:
        _absent.clear()


def _say_created() -> None:
    for folder in sorted(_absent):
        if folder.is_dir():
            _absent.remove(folder)
            say(f"created folder {folder}")


def next_step(text: str) -> None:
    """Print what is useful next, unless --quiet is given: the last lines of a verb."""
    _say_created()
    say(f"next: {text}")


def next_command(command: str, path: Path | None = None, options: str = "") -> None:
    """Print a command that is useful next, unless --quiet is given."""
    words = [command, *([] if path is None else [shlex.quote(str(path))]), *([options] if options else [])]
    next_step(" ".join(words))


def show(text: str, *, json: bool = False) -> None:
    """Print a result for people: to the standard output, or with `json`, which is for programs, the standard error."""
    display.close()
    print(printable(text), file=sys.stderr if json else sys.stdout, flush=True)


def console(*, errors: bool) -> "Console":
    """Return a console that `show` replaces, for `avmsf check`."""
    from rich.console import Console

    stream = sys.stderr if errors else sys.stdout
    return Console(file=stream, width=None if stream.isatty() else 120, markup=False, highlight=False, emoji=False)


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object to the standard output: what is not finite becomes null, what JSON does not know text."""
    show(json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False, default=str))


def print_result(text: str, values: Mapping[str, Any], *, json: bool) -> None:
    """Print a verb's result: as text, or as JSON with the text on the standard error."""
    show(text, json=json)
    if json:
        print_json(values)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
