"""Mesh files rewritten in the part of their format that trimesh reads right: tabs, negative indices, integers."""

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from avmsf._utils.text_files import parse_json
from avmsf.errors import CaptureError

_UNUSUAL = re.compile(rb"\A\xef\xbb\xbf|^[ \t]+[vf]|^[vf][^\n]*\t|^f[^\n]*[ /]-", re.MULTILINE)
"""A byte-order mark, tabs or spaces where one space is usual, and negative indices."""
_INTEGERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}
_WIDTHS = {"VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT32 = 5126
"""Types of numbers in a glTF's accessors, and of what they form."""
_COMPRESSED = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshoptimizer"}


def plain_mesh(path: Path) -> bytes | None:
    """Return the rewritten content of an OBJ or GLB file; None where the file is plain already, or of another kind."""
    suffix = path.suffix.lower()
    if suffix == ".obj":
        content = path.read_bytes()
        return _plain_obj(content) if _UNUSUAL.search(content) else None
    return _plain_glb(path.read_bytes()) if suffix == ".glb" else None


def _plain_obj(content: bytes) -> bytes:
    """Return an OBJ file with single spaces, without a byte-order mark, and with indices counted from the first."""
    counts, lines = {b"v": 0, b"vt": 0, b"vn": 0}, []
    content = content.removeprefix(b"\xef\xbb\xbf").replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    for line in content.splitlines():
        words = line.partition(b"#")[0].split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        elif words and words[0] == b"f":
            words[1:] = [_counted(word, tuple(counts.values())) if b"-" in word else word for word in words[1:]]
        else:
            words = [line]
        lines.append(b" ".join(words))
    return b"\n".join(lines)


def _counted(corner: bytes, counts: tuple[int, ...]) -> bytes:
    """Return one corner of a face, such as -3/-3, with indices from 1; negative ones count back from the last."""
    found = []
    for index, count in zip(corner.split(b"/"), counts, strict=False):
        if index.startswith(b"-") and count + int(index) < 0:
            raise CaptureError.expected(f"an index from -{count} to -1", int(index), name="f")
        found.append(b"%d" % (count + 1 + int(index)) if index.startswith(b"-") else index)
    return b"/".join(found)


def expect_uncompressed(record: Any) -> None:
    """Raise CaptureError for the JSON of a glTF whose meshes are compressed."""
    required = record.get("extensionsRequired") if isinstance(record, dict) else None
    for name in required if isinstance(required, list) else ():
        if name in _COMPRESSED:
            raise CaptureError(
                f"expected a mesh without compression, got one compressed by {_COMPRESSED[name]}; export it without",
                name="extensionsRequired",
                value=name,
            )


def _normalized(record: Any) -> list[dict[str, Any]]:
    """Return the accessors of positions, normals and texture coordinates whose integers stand for -1 to 1."""
    primitives = [each for mesh in record.get("meshes", ()) for each in mesh["primitives"]]
    used = {row for each in primitives for name, row in each["attributes"].items() if not name.startswith("COLOR")}
    chosen = (record["accessors"][row] for row in sorted(used))
    return [each for each in chosen if each.get("normalized") and each["componentType"] in _INTEGERS]


def _plain_glb(content: bytes) -> bytes | None:
    """Return a binary glTF with normalized integers (KHR_mesh_quantization) as floats; None where it has none."""
    start = 20 + struct.unpack_from("<I", content, 12)[0]
    record = parse_json(content[20:start].decode("utf-8"))
    body = content[start + 8 : start + 8 + struct.unpack_from("<I", content, start)[0]] if len(content) > start else b""
    chosen = _normalized(record)
    for each in chosen:
        kind, width = np.dtype(_INTEGERS[each["componentType"]]), _WIDTHS[each["type"]]
        view = record["bufferViews"][each["bufferView"]]
        strides = view.get("byteStride", width * kind.itemsize), kind.itemsize
        offset = view.get("byteOffset", 0) + each.get("byteOffset", 0)
        values = np.ndarray((each["count"], width), kind, body, offset, strides) / np.iinfo(kind).max
        floats = np.maximum(values, -1.0).astype("<f4").tobytes()
        body += bytes(-len(body) % 4)
        each.update(bufferView=len(record["bufferViews"]), byteOffset=0, componentType=_FLOAT32, normalized=False)
        record["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": len(floats)})
        body += floats
    if not chosen:
        return None
    record["buffers"][0]["byteLength"] = len(body)
    text = json.dumps(record).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
