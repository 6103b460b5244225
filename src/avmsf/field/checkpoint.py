"""What an interrupted fit goes on from."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from avmsf.errors import FieldFileError


def write_whole(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file beside `path`, then put it in its place in one step.

    What was there stays whole until then: a full disk or a kill leaves the old file. Raises `FieldFileError`.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        write(temporary)
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        # mkstemp makes files that only their owner reads; a field is for sharing like any other file.
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        os.replace(temporary, path)
    except OSError as error:
        raise FieldFileError(
            f"{path}: cannot be written ({error.strerror or error}); what was there is untouched: free some space or "
            "choose another place"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a fit's state: tensors, numbers, words and containers of these."""
    write_whole(path, lambda place: torch.save(state, place))


def read_checkpoint(path: Path, *, fingerprint: str) -> dict[str, Any] | None:
    """Return the state at `path`, None where there is none.

    Raises `FieldFileError` for a file that is no checkpoint, or one of a fit to other recordings or with other
    settings, which `fingerprint` tells.
    """
    if not path.exists():
        return None
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True)
        found = state["fingerprint"]
    except Exception as error:  # torch.load raises whatever unpacking raises
        raise FieldFileError(
            f"{path}: expected a checkpoint of a fit, found something else ({error}): delete it or name another"
        ) from error
    if found != fingerprint:
        raise FieldFileError(
            f"{path}: this checkpoint belongs to a fit of other recordings, features or settings: delete it to start "
            "anew, or repeat that fit's arguments to go on with it"
        )
    return state
