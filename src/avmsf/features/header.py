"""How a file of features is recognized; importing this loads nothing that computes."""

from pathlib import Path

from avmsf._utils.headers import read_metadata

KEY = "avmsf_features"
"""Entry of a file's metadata that holds the features' record."""


def holds_features(path: Path) -> bool:
    """Return whether the header of a file says that it holds features, and not for example a field."""
    try:
        return KEY in read_metadata(path)
    except (OSError, ValueError):
        return False
