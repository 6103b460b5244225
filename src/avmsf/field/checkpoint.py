"""What an interrupted fit goes on from."""

import io
from pathlib import Path
from typing import Any

import torch

from avmsf.errors import FieldFileError
from avmsf.files import write_whole


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a fit's state: tensors, numbers, words and containers of these. Raises `FieldFileError`."""
    # By way of memory: torch's own writer reports a full disk as a RuntimeError of its archive format.
    content = io.BytesIO()
    torch.save(state, content)
    write_whole(path, lambda place: place.write_bytes(content.getvalue()))


def read_checkpoint(path: Path, *, fingerprint: str) -> dict[str, Any] | None:
    """Return the state at `path`, None where there is none.

    Raises `FieldFileError` for a file that is no checkpoint, or one of a fit to other recordings or with other
    settings, which `fingerprint` tells.
    """
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
        found = state["fingerprint"]
    # torch.load raises whatever unpacking raises, in words that advise to trust the file.
    except Exception as error:
        raise FieldFileError(
            f"{path}: expected a checkpoint of a fit, found something else or a part of one: delete it or name another"
        ) from error
    if found != fingerprint:
        raise FieldFileError(
            f"{path}: this checkpoint belongs to a fit of other recordings, features, modes or settings, or of another "
            "version: delete it to start anew, or repeat that fit's arguments to go on with it"
        )
    return state
