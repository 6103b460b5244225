"""Tensors in files: safetensors with one text, and checkpoints of work that may be interrupted."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from avmsf.errors import AvmsfError
from avmsf.files import write_whole


def read_tensors(
    path: Path, key: str, *, what: str, advice: str, raising: type[AvmsfError]
) -> tuple[str, dict[str, Tensor]]:
    """Return the text under `key` in the metadata of a safetensors file, and its tensors.

    Raises `raising` for a file that is missing, damaged or of another kind: `what` it should be, and the `advice`.
    """
    if not path.exists():
        raise raising(f"{path}: expected {what}, found no such file: check the name, or {advice}")
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(key)
            if text is None:
                raise raising(
                    f"{path}: expected {what}, found a safetensors file of something else (its metadata has no entry "
                    f"{key!r}): name another, or {advice}"
                )
            # Clones, for what the file maps into memory would change with it.
            return text, {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise raising(f"{path}: expected {what}, found {_guess(path, advice)}") from error


def _guess(path: Path, advice: str) -> str:
    """Return what a file is that safetensors cannot read, and what to do."""
    if path.is_dir():
        return "a folder: name the file in it"
    try:
        with open(path, "rb") as file:
            start = file.read(9)
    except OSError as error:
        return f"a file that cannot be read ({error.strerror}): check its permissions"
    if not start:
        return f"an empty file: copy it again, or {advice}"
    # Eight bytes of length, then the header's opening brace.
    if start[8:] == b"{":
        return f"one that is cut short or damaged: copy it again, or {advice}"
    return f"a file of another kind, which starts with {start[:8]!r}: name another, or {advice}"


def write_checkpoint(
    path: Path, state: Mapping[str, Any], identity: Mapping[str, str], *, raising: type[AvmsfError]
) -> None:
    """Write a state, tensors, numbers, text and containers of these, and what it belongs to. Raises `raising`."""
    # By way of memory: torch's own writer reports a full disk as a RuntimeError of its archive format.
    content = io.BytesIO()
    torch.save({"identity": dict(identity), "state": dict(state)}, content)
    write_whole(path, lambda place: place.write_bytes(content.getvalue()), raising=raising)


def read_checkpoint(
    path: Path, identity: Mapping[str, str], *, what: str, raising: type[AvmsfError]
) -> dict[str, Any] | None:
    """Return the state at `path`, None where there is none.

    Raises `raising` for a file that is no checkpoint of `what`, and for one of another identity: a digest of each thing
    that decides the result, by what errors call it.
    """
    if not path.exists():
        return None
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
        state, found = content["state"], content["identity"]
        other = sorted(name for name in identity.keys() | found.keys() if identity.get(name) != found.get(name))
    # torch.load raises whatever unpacking raises, with the advice to trust the file.
    except Exception as error:
        raise raising(
            f"{path}: expected a checkpoint of {what}, found something else or a part of one: delete it or name another"
        ) from error
    if other:
        raise raising(
            f"{path}: this checkpoint belongs to {what} with another {' and another '.join(other)}: delete it to start "
            "again from the beginning, or repeat its arguments to go on with it"
        )
    return dict(state)
