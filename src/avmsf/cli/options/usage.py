"""Errors of options that cannot be understood, in this package's words: tyro prints a box of text and no more."""

import re
import textwrap
from collections.abc import Callable
from itertools import dropwhile, takewhile

from avmsf.errors import AvmsfError

_FRAME = re.compile(r"\x1b\[[\d;]*m|[│╭╮╰╯]")
_OPTION = re.compile(r"--[\w.-]+")


class UsageExit(SystemExit):
    """Options cannot be understood, as the standard error explains, and `error` in one sentence."""

    def __init__(self, error: AvmsfError) -> None:
        super().__init__(2)
        self.error = error


def usage_error(box: str) -> AvmsfError:
    """Return the error that a box of tyro (1.0.17) shows; with tyro's sentence alone where it is of no known form."""
    inside = [_FRAME.sub("", line).rstrip() for line in box.splitlines()[1:]]
    # Without characters for frames, a rule is below the title.
    lines = list(dropwhile(_is_rule, inside))
    first = list(takewhile(lambda line: not _is_rule(line), lines))
    sentence, rest = (" ".join(" ".join(part).split()) for part in (first, lines[len(first) :]))
    page = re.search(r"avmsf[\w ]*(?= --help)", rest)
    command = page[0] if page else "avmsf"
    if sentence.startswith("Missing from "):
        return _absent(first, command)
    for form, error in _FORMS:
        if found := form.fullmatch(sentence):
            return error(found, command, rest)
    return AvmsfError(sentence)


def _is_rule(line: str) -> bool:
    return bool(line) and not line.strip("─- ")


def _absent(lines: list[str], command: str) -> AvmsfError:
    """Return the error of required arguments, whose names are indented by four columns and their help by more."""
    starts = re.findall(r"^ {4}(\S.*)", textwrap.dedent("\n".join(lines)), re.MULTILINE)
    names = [(_OPTION.findall(start) or start.split())[-1] for start in starts]
    message = f"{' and '.join(names)}: expected a value, got none; see `{command} --help`"
    return AvmsfError(message, name=names[0] if names else None)


def _choice(found: re.Match[str], command: str, rest: str) -> AvmsfError:
    words = ", ".join(re.findall(r"[\w.-]+", found["wanted"]))
    return AvmsfError.expected(f"one of {words}", found["value"], name=_long(found["name"]))


def _value(found: re.Match[str], command: str, rest: str) -> AvmsfError:
    wanted, got = ("a value", "none") if found["count"] == "1" else (f"{found['count']} values", "fewer")
    return AvmsfError.expected(wanted, got=got, name=_long(found["name"]), advice=f"see `{command} --help`")


def _number(found: re.Match[str], command: str, rest: str) -> AvmsfError:
    wanted = "a whole number" if "int()" in found["kind"] else "a number"
    return AvmsfError.expected(wanted, found["value"], name=_long(found["name"]))


def _numbers(found: re.Match[str], command: str, rest: str) -> AvmsfError:
    words = " ".join(re.findall(r"'(.*?)'", found["value"]))
    return AvmsfError.expected("numbers", words, name=_long(found["name"]))


def _unknown(found: re.Match[str], command: str, rest: str) -> AvmsfError:
    near = re.search(rf"Perhaps you meant:.*?({_OPTION.pattern})", rest)
    return _unexpected(found["value"], command, f"did you mean {near[1]}? " if near else "")


def _misplaced(found: re.Match[str], command: str, rest: str) -> AvmsfError:
    return _unexpected(found["value"], found["command"], "")


def _unexpected(value: str, command: str, advice: str) -> AvmsfError:
    wanted = "a known option" if value.startswith("-") else "no such argument"
    return AvmsfError.expected(wanted, value, name=command, advice=f"{advice}`{command} --help` lists all")


def _long(name: str) -> str:
    """Return the long one of the names of an option, `-o/--output`."""
    return name.rpartition("/")[2]


_FORMS: tuple[tuple[re.Pattern[str], Callable[[re.Match[str], str, str], AvmsfError]], ...] = (
    (
        re.compile(r"invalid choice '(?P<value>.*)' for argument '(?P<name>[^']*)'\. Expected one of (?P<wanted>.*)\."),
        _choice,
    ),
    (re.compile(r"Missing value for argument '(?P<name>[^']*)'\. Expected (?P<count>\d+) values\."), _value),
    (re.compile(r"Error parsing (?P<name>\S+): (?P<kind>.*(?:int\(\)|to float).*): '(?P<value>.*)'"), _number),
    (
        re.compile(r"Error parsing (?P<name>\S+): Could not (?:find valid )?parse.* arguments:? (?P<value>\[.*\]).*"),
        _numbers,
    ),
    (re.compile(r"Unrecognized options: (?P<value>.*?)(?:, .*)?"), _unknown),
    (re.compile(r"Unrecognized or misplaced options: (?P<value>.*?) \(applied to (?P<command>.*?)\).*"), _misplaced),
)
"""Sentences of tyro, and what makes an error of each."""
