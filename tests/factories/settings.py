"""Settings of a command in one text."""


def sets(settings: str) -> tuple[str, ...]:
    """Return the arguments --set NAME=VALUE of settings that blanks separate."""
    return tuple(word for each in settings.split() for word in ("--set", each))
