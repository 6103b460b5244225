"""Words for people: numbers with their nouns, configurations in one line, and no control characters of a file's."""

from dataclasses import fields
from typing import Any

_MAX_CHANGES = 4
"""Settings that a configuration names."""
_HIDDEN = [*range(0x20), 0x7F, *range(0x80, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)]
"""Control characters of terminals (C0, DEL, C1), and those that reverse the direction of what follows."""
_ESCAPES = {code: chr(code).encode("unicode_escape").decode() for code in _HIDDEN if chr(code) not in "\n\t"}


def changes_repr(config: Any) -> str:
    """Return a configuration's name and what differs from its defaults, in one line. For use as `__repr__`."""
    usual = type(config)()
    pairs = ((each.name, getattr(config, each.name)) for each in fields(config))
    changed = [f"{name}={value!r}" for name, value in pairs if value != getattr(usual, name)]
    more = [f"and {len(changed) - _MAX_CHANGES} more"] if len(changed) > _MAX_CHANGES else []
    return f"{type(config).__name__}({', '.join(changed[:_MAX_CHANGES] + more)})"


def printable(text: str) -> str:
    """Return text with control characters, except line feeds and tabs, as escape sequences that a terminal shows."""
    return text.translate(_ESCAPES)


def counted(number: int, thing: str) -> str:
    """Return a number with its noun, whose plural ends in s: "1 file", "2 files"."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
