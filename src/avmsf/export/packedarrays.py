"""Arrays one after another in a binary file, and the JSON manifest that says where each begins: packed, and read."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from avmsf._utils.text_files import read_json
from avmsf.errors import ExportError
from avmsf.export.written import MANIFEST


def pack(arrays: Mapping[str, Shaped[np.ndarray, "..."]]) -> tuple[bytes, dict[str, dict[str, Any]]]:
    """Return the file's content, in which each array begins at a multiple of four bytes, and where."""
    content, places = b"", {}
    for name, array in arrays.items():
        content += b"\0" * (-len(content) % 4)
        places[name] = {"offset": len(content), "dtype": array.dtype.name, "shape": list(array.shape)}
        content += array.tobytes()
    return content, places


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder; raises `ExportError` where it is missing or no JSON object."""
    path = folder / MANIFEST
    try:
        found = read_json(path)
    except OSError as error:
        raise ExportError(
            f"{path}: expected the manifest of the paper's demo, found none ({error.strerror or error}): name a folder "
            "that holds one"
        ) from error
    except ValueError as error:
        raise ExportError(f"{path}: expected JSON, found something else ({error}): export it again") from error
    if not isinstance(found, dict):
        raise ExportError(f"{path}: expected a JSON object, found {type(found).__name__}: export it again")
    return found


def number_in(manifest: Mapping[str, Any], names: tuple[str, ...], path: Path) -> int:
    """Return a whole number from 1 that goes by one of these names; raises `ExportError` for others, with the path."""
    value = next((manifest[name] for name in names if name in manifest), None)
    if type(value) is not int or value < 1:
        raise ExportError(f"{path}: expected {names[0]!r} as a whole number from 1, found {value!r}: mend it")
    return value


def described(manifest: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    """Return where an array is: its offset in bytes alone, or a record of it, at the top or in a group.

    Raises `ExportError`, which names the manifest at `path`, for no such array, no offset, and a shape that is none.
    """
    groups = [manifest, *(manifest[key] for key in ("arrays", "offsets", "buffers") if key in manifest)]
    for group in groups:
        if isinstance(group, Mapping) and name in group:
            found = group[name]
            record = {"offset": found} if type(found) is int else found
            if isinstance(record, dict):
                record = {**record, "offset": record.get("offset", record.get("byteOffset"))}
                if not _is_shape(record.get("shape", [1])):
                    raise ExportError(
                        f"{path}: expected the shape of {name!r} as whole numbers from 1, found {record['shape']!r}: "
                        "mend it"
                    )
                if type(record["offset"]) is int and record["offset"] >= 0:
                    return record
            raise ExportError(f"{path}: expected the offset of {name!r} in bytes, found {found!r}: mend it")
    raise ExportError(f"{path}: expected where {name!r} begins, found {', '.join(manifest) or 'nothing'}: mend it")


def read_array(
    path: Path, manifest: Mapping[str, Any], name: str, shape: tuple[int, ...], kind: str
) -> Shaped[np.ndarray, "..."]:
    """Return an array of a file of such a shape and type; raises `ExportError` where it is not so, or not finite."""
    place = described(manifest, name, path.with_name(MANIFEST))
    if tuple(place.get("shape", shape)) not in (shape, (*shape, 1)):
        raise ExportError(
            f"{path.with_name(MANIFEST)}: expected {name!r} of shape {list(shape)}, found {place['shape']}: "
            "the two manifests belong to different objects"
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ExportError(f"{path}: cannot be read ({error.strerror or error}): export it again") from error
    layout = np.dtype(kind).newbyteorder("<")
    needed = place["offset"] + layout.itemsize * math.prod(shape)
    if needed > len(content):
        raise ExportError(f"{path}: {name!r} ends at byte {needed} of {len(content)}: it was cut short, copy it again")
    values = np.frombuffer(content, layout, math.prod(shape), place["offset"]).reshape(shape)
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        raise ExportError(
            f"{path}: expected finite numbers in {name!r}, found {values[tuple(wrong[0])]} in row {wrong[0][0]}: "
            "export it again"
        )
    return values


def _is_shape(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(type(each) is int and each > 0 for each in value)
