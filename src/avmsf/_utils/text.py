"""Text that comes from files, made safe to print."""

_HIDDEN = [*range(0x20), 0x7F, *range(0x80, 0xA0), *range(0x202A, 0x202F), *range(0x2066, 0x206A)]
"""Control characters of terminals (C0, DEL, C1), and those that reverse the direction of what follows."""
_ESCAPES = {code: chr(code).encode("unicode_escape").decode() for code in _HIDDEN if chr(code) not in "\n\t"}


def printable(text: str) -> str:
    """Return text with control characters, except line feeds and tabs, as escape sequences that a terminal shows."""
    return text.translate(_ESCAPES)
