"""Published models: their names on the hub, why one cannot be had, and their settings."""

from pathlib import Path
from typing import Any

from avmsf._utils.text import read_json
from avmsf.errors import AvmsfError

HUB_SECONDS = 5.0
"""How long to wait for the hub's answer."""


def is_hub_name(source: str | Path) -> bool:
    """Return whether a source that is no folder may be a model's name: an owner and a model, where paths differ."""
    words = str(source).split("/")
    return isinstance(source, str) and len(words) == 2 and all(words) and words[0][0] not in ".~"


def why_not(error: BaseException) -> str:
    """Return in plain words why a model could not be downloaded, from an error of the hub's client or its cause."""
    response = getattr(error, "response", None)
    if response is not None:
        return f"the server answered with code {response.status_code}"
    if error.__cause__ is not None:
        return why_not(error.__cause__)
    if "Connect" in type(error).__name__ or isinstance(error, ConnectionError | TimeoutError):
        return "the server cannot be reached"
    return next(iter(str(error).strip().splitlines()), type(error).__name__)[:200].rstrip(".")


def read_settings(path: Path, *, raising: type[AvmsfError]) -> dict[str, Any]:
    """Return the JSON object in a model's file. Raises `raising` for anything else."""
    try:
        record = read_json(path)
    except (OSError, ValueError) as error:
        raise raising(f"{path}: expected a JSON file, got {error}; copy it again", file=path) from error
    if not isinstance(record, dict):
        found = type(record).__name__
        raise raising(f"{path}: expected a JSON object, got {found}; copy it again", file=path, value=found)
    return record
