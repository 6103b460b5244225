"""Arrays one after another in a binary file, and the JSON manifest with the offset of each: packed, and read."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from avmsf._utils.text_files import read_json
from avmsf.errors import ExportError
from avmsf.export.writing import MANIFEST


def pack(arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return the file's content, in which each array begins at a multiple of four bytes, and where."""
    content, places = b"", {}
    for name, array in arrays.items():
        content += b"\0" * (-len(content) % 4)
        places[name] = {"offset": len(content), "dtype": array.dtype.name, "shape": list(array.shape)}
        content += array.tobytes()
    return content, places


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder; raises `ExportError` where it is missing or not a JSON object."""
    path = folder / MANIFEST
    try:
        found = read_json(path)
    except OSError as error:
        raise unreadable(path, error, "name a folder of the paper's demo") from error
    except ValueError as error:
        raise ExportError(f"{path}: expected JSON ({error}); export it again", file=path) from error
    if not isinstance(found, dict):
        kind = type(found).__name__
        raise ExportError(f"{path}: expected a JSON object, got {kind}; export it again", file=path, value=kind)
    return found


def unreadable(path: Path, error: OSError, advice: str) -> ExportError:
    """Return the error for a file that the system does not read."""
    reason = error.strerror or str(error)
    return ExportError(f"{path}: expected a readable file, got {reason!r}; {advice}", file=path, value=reason)


def number_in(manifest: Mapping[str, Any], names: tuple[str, ...], path: Path) -> int:
    """Return a whole number from 1 under one of these names; raises `ExportError` for others, with the path."""
    value = next((manifest[name] for name in names if name in manifest), None)
    if type(value) is not int or value < 1:
        raise _manifest_error(path, names[0], "a whole number from 1", value)
    return value


def described(manifest: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    """Return where an array is: its offset in bytes alone, or a record of it, at the top or in a group.

    Raises `ExportError`, with the manifest at `path`, for no such array, no offset, and a shape that cannot be.
    """
    groups = [manifest, *(manifest[key] for key in ("arrays", "offsets", "buffers") if key in manifest)]
    for group in groups:
        if isinstance(group, Mapping) and name in group:
            found = group[name]
            record = {"offset": found} if type(found) is int else found
            if isinstance(record, dict):
                record = {**record, "offset": record.get("offset", record.get("byteOffset"))}
                if not _is_shape(record.get("shape", [1])):
                    raise _manifest_error(path, f"{name}.shape", "whole numbers from 1", record["shape"])
                if type(record["offset"]) is int and record["offset"] >= 0:
                    return record
            raise _manifest_error(path, f"{name}.offset", "an offset in bytes", found)
    raise _manifest_error(path, name, "an offset in bytes", None)


def _manifest_error(path: Path, name: str, expected: str, value: Any) -> ExportError:
    found = "none" if value is None else repr(value)
    return ExportError(
        f"{path}: {name}: expected {expected}, got {found}; correct it", file=path, name=name, value=value
    )


def read_array(
    path: Path, manifest: Mapping[str, Any], name: str, shape: tuple[int, ...], kind: str
) -> Shaped[np.ndarray, "..."]:
    """Return an array of a file of such a shape and type; raises `ExportError` where it is not so, or not finite."""
    place = described(manifest, name, path.with_name(MANIFEST))
    if tuple(place.get("shape", shape)) not in (shape, (*shape, 1)):
        manifest_path = path.with_name(MANIFEST)
        raise ExportError(
            f"{manifest_path}: {name}: expected the shape {list(shape)} of the other manifest, got {place['shape']}; "
            "export both again",
            file=manifest_path,
            name=name,
            value=place["shape"],
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise unreadable(path, error, "export it again") from error
    layout = np.dtype(kind).newbyteorder("<")
    needed = place["offset"] + layout.itemsize * math.prod(shape)
    if needed > len(content):
        raise ExportError(
            f"{path}: {name}: expected {needed} bytes or more, got {len(content)}; copy the file again",
            file=path,
            name=name,
            value=len(content),
        )
    values = np.frombuffer(content, layout, math.prod(shape), place["offset"]).reshape(shape)
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        row, value = int(wrong[0][0]), float(values[tuple(wrong[0])])
        raise ExportError(
            f"{path}: {name}, row {row}: expected finite numbers, got {value}; export it again",
            file=path,
            row=row,
            name=name,
            value=value,
        )
    return values


def _is_shape(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(type(each) is int and each > 0 for each in value)
