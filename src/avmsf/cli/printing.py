"""What the commands print: tables and text for people, JSON for programs, each on its own stream."""

import json
import math
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Task, TextColumn
from rich.table import Table
from rich.text import Text

from avmsf._utils.text import printable
from avmsf.cli.heartbeat import printed, verbosity

_WIDTH = 120
"""Columns of tables that go to a file or a pipe, which have no width of their own."""


class _SafeConsole(Console):
    """A console on which what stands in files is only text: names and reports hold what others have written there."""

    def render_str(self, text: str, **settings: Any) -> Text:
        """Return text to print, in which control characters are written out."""
        return super().render_str(printable(text), **settings)


class SafeColumn(TextColumn):
    """A column of a progress bar whose words may hold file names: neither markup nor control characters act in it."""

    def render(self, task: Task) -> Text:
        """Return the words of a task."""
        return Text(printable(self.text_format.format(task=task)))


def console(*, errors: bool) -> Console:
    """Return where tables and bars go: the standard output, or with `errors` the standard error, left free by JSON."""
    stream = sys.stderr if errors else sys.stdout
    # File names and messages hold square brackets, which would be taken for markup.
    width = None if stream.isatty() else _WIDTH
    return _SafeConsole(file=stream, width=width, markup=False, highlight=False, emoji=False)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, words: int = 1) -> Table:
    """Return a table whose first `words` columns are words, set left, and the others figures, set right."""
    drawn = Table(title=title, title_justify="left")
    for place, column in enumerate(columns):
        left = place < words
        drawn.add_column(column, justify="left" if left else "right", overflow="fold" if left else "ellipsis")
    for row in rows:
        drawn.add_row(*row)
    return drawn


def decimals(value: float | int | None, places: int) -> str:
    """Return a number with so many decimals; a dash for None."""
    return "–" if value is None else f"{value:.{places}f}"


def say(text: str) -> None:
    """Print a line of progress to the standard error, unless --quiet is given; a note or a warning always."""
    if not verbosity.quiet or text.startswith(("note: ", "avmsf ")):
        print(printable(text), file=sys.stderr, flush=True)
    printed(text)


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


def print_text(text: str) -> None:
    """Print a result to the standard output."""
    print(printable(text))


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object to the standard output."""
    print_text(json_text(value))


def print_result(text: str, values: Mapping[str, Any], *, json: bool) -> None:
    """Print a verb's result: as text, or as JSON with the text on the standard error."""
    console(errors=json).print(text, soft_wrap=True)
    if json:
        print_json(values)


def json_text(value: Mapping[str, Any]) -> str:
    """Return valid JSON: numbers that are not finite become null, and what JSON does not know becomes text."""
    return json.dumps(_plain(value), indent=2, ensure_ascii=False, allow_nan=False, default=str)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
