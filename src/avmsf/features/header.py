"""How a file of features is recognized; importing this loads nothing that computes."""

from pathlib import Path

from avmsf._utils.headers import MAX_HEADER_BYTES

KEY = "avmsf_features"
"""Entry of a file's metadata that holds the features' record."""


def holds_features(path: Path) -> bool:
    """Return whether the header of a file says that it holds features, and not for example a field."""
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            return f'"{KEY}"'.encode() in file.read(min(length, MAX_HEADER_BYTES))
    except OSError:
        return False
