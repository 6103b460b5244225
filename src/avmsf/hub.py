"""Published models: their names on the hub, whether the hub answers, and their settings."""

from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from avmsf._utils.text_files import read_json
from avmsf.errors import AvmsfError

HUB_SECONDS = 5.0
"""How long to wait for the hub's answer."""


def is_hub_name(source: str | Path) -> bool:
    """Return whether a source that is no folder may be a model's name: an owner and a model, where paths differ."""
    words = str(source).split("/")
    return isinstance(source, str) and len(words) == 2 and all(words) and words[0][0] not in ".~"


def expect_answer(name: str, file: str) -> None:
    """Ask the hub once for a model's file, unless its client is told to stay offline; raise OSError where nobody is.

    Without a network, or where the hub itself fails, its client tries again for half a minute. A refusal is an answer:
    the client asks again with the user's token. Needs the package huggingface_hub.
    """
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return
    try:
        urlopen(Request(f"{constants.ENDPOINT}/{name}/resolve/main/{file}", method="HEAD"), timeout=HUB_SECONDS).close()
    except HTTPError as refusal:
        refusal.close()
        if refusal.code >= 500:
            raise


def why_not(error: Exception) -> str:
    """Return in plain words why a model could not be downloaded."""
    if isinstance(error, HTTPError):
        return f"the server answered with code {error.code}"
    if isinstance(error, URLError | ConnectionError | TimeoutError):
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
