"""Words for people in which a number stands."""


def counted(number: int, thing: str) -> str:
    """Return a number with its noun, whose plural ends in s: "1 file", "2 files"."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"
