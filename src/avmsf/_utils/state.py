"""Tensors in files: safetensors with one text, and checkpoints of work that may be interrupted."""

import io
import json
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from avmsf._utils.files import write_whole
from avmsf._utils.headers import read_header_text, unreadable
from avmsf._utils.text import parse_json
from avmsf.errors import AvmsfError


def read_tensors(
    path: Path, key: str, *, what: str, advice: str, raising: type[AvmsfError]
) -> tuple[str, dict[str, Tensor]]:
    """Return the text under `key` in the metadata of a safetensors file, and its tensors.

    Raises `raising` for a file that is missing, damaged or of another kind: `what` it should be, and the `advice`.
    """
    text = read_header_text(path, key, what=what, advice=advice, raising=raising)
    try:
        with safe_open(path, framework="pt") as file:
            # Clones, for what the file maps into memory would change with it.
            return text, {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise unreadable(path, what=what, advice=advice, raising=raising) from error


def parse_record(
    text: str,
    path: Path,
    check: Callable[[dict[str, Any]], None],
    *,
    formats: tuple[int, ...],
    what: str,
    advice: str,
    raising: type[AvmsfError],
) -> dict[str, Any]:
    """Return the record that a file's header has as JSON, with a `format` and the `version` that wrote it.

    `check` raises ValueError, TypeError or KeyError for a record whose entries are not those of the formats. Raises
    `raising` for such a record, and for a format of another version.
    """
    try:
        record = parse_json(text)
        found, writer = record["format"], record["version"]
        if found in formats:
            check(record)
    except (ValueError, TypeError, KeyError) as error:
        got = f"a damaged one ({type(error).__name__}: {error})"
        raise raising.expected(f"the header of {what}", got=got, file=path, name="header", advice=advice) from error
    if found not in formats:
        wanted = f"{what} in format {' or '.join(map(str, formats))}"
        got = f"format {found}, written by avmsf {writer} (this is avmsf {version('avmsf')})"
        advice = f"install avmsf {writer} or newer, or {advice}"
        raise raising.expected(wanted, found, got=got, file=path, name="format", advice=advice)
    return record


def record_text(record: Mapping[str, Any], path: Path, *, name: str, raising: type[AvmsfError]) -> str:
    """Return a record as JSON. Raises `raising` for what JSON does not hold, which came in its entry `name`."""
    try:
        return json.dumps(record, allow_nan=False)
    except (TypeError, ValueError) as error:
        wanted, got = "finite numbers, text, lists and dicts", f"other values ({error})"
        raise raising.expected(wanted, str(error), got=got, file=path, name=name) from error


def expect_tensors(
    tensors: Mapping[str, Tensor],
    sizes: Mapping[str, tuple[int, ...]],
    path: Path,
    *,
    dtype: torch.dtype,
    advice: str,
    raising: type[AvmsfError],
) -> None:
    """Raise `raising` unless these are the tensors of these names, sizes and type, all of finite numbers."""
    found = {name: tuple(tensor.shape) for name, tensor in tensors.items() if tensor.dtype == dtype}
    if found != sizes or tensors.keys() != sizes.keys():
        wanted = f"the {str(dtype).removeprefix('torch.')} tensors {dict(sizes)}"
        shapes = {name: list(tensor.shape) for name, tensor in tensors.items()}
        raise raising.expected(wanted, shapes, file=path, name="tensors", advice=advice)
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise raising.expected(f"finite {name}", got="others", file=path, name=name, advice=advice)


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
        advice = "delete it or name another"
        raise raising.expected(
            f"a checkpoint of {what}", got="another or a damaged file", file=path, advice=advice
        ) from error
    if other:
        wanted = f"a checkpoint of {what} with the same {' and '.join(other)}"
        advice = "delete it to start again, or repeat its arguments to continue it"
        raise raising.expected(wanted, other, got="another", file=path, advice=advice)
    return dict(state)
