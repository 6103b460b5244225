"""Mesh files (obj, ply, glb, gltf, stl, off) opened by trimesh, within bounds that are checked before and after.

Every reader of meshes goes through `load_mesh`, so that what it returns has indices that exist and finite coordinates.
"""

import io
import json
import logging
import re
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from avmsf._utils.files import is_lfs_pointer
from avmsf._utils.text import parse_json, read_json
from avmsf.errors import AvmsfError, CaptureError

MESH_SUFFIXES = (".obj", ".ply", ".glb", ".gltf", ".stl", ".off")
MAX_BYTES = 1 << 30
"""Largest mesh file: `MAX_FACES` triangles as text with normals and texture coordinates."""
MAX_GLTF_BYTES = 64 << 20
"""Largest text glTF: 1.5 million triangles in buffers that it holds as base64. Text of this length that is nothing but
JSON takes at most about 2 GB as Python objects; a binary glTF holds its buffers outside of the JSON."""
MAX_FACES = 5_000_000
"""Triangles of a mesh with all its parts: thirty times what the largest published scans of objects have. They take
about 1 GB while they are read."""
MAX_PARTS = 1_000
"""Parts of a mesh, each placed by a node or a material of its own. A struck object has a few; each takes a millisecond
and more to place, texture and render."""
MAX_COORDINATE = 1e9
"""Largest coordinate, in the file's unit: a kilometer in micrometers. Its cube is an ordinary number in float32."""
MAX_TEXTURE_PIXELS = 3 * 8192**2
"""Pixels of all textures: three pictures of 8192 x 8192, the largest that GPUs of all makes take. 0.6 GB."""
_COMMAS = re.compile(rb"^\s*(v|vertex)\s+-?[0-9]+,[0-9]", re.MULTILINE)
_UNUSUAL = re.compile(rb"\A\xef\xbb\xbf|^[ \t]+[vf]|^[vf][^\n]*\t|^f[^\n]*[ /]-", re.MULTILINE)
"""A byte-order mark, tabs or spaces where one space is usual, and negative indices."""
_INTEGERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2"}
_WIDTHS = {"VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT32, _USHORT = 5126, 5123
"""Types of numbers in a glTF's accessors, and of what they form."""
_COMPRESSED = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshoptimizer"}
# Of a missing texture trimesh logs a traceback, which goes to the terminal where nothing else takes it.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def load_mesh(path: Path, *, raising: type[AvmsfError] = CaptureError) -> trimesh.Scene:
    """Return a mesh file's parts and where they stand, as they are in the file; vertices keep their order.

    All vertices are finite and all faces name vertices that exist. Raises `raising` for a file that is missing, larger
    than the bounds above, of another format, or damaged.
    """
    try:
        _check_size(path)
        with warnings.catch_warnings():
            # numpy's casts of damaged numbers; the results are checked below.
            warnings.simplefilter("ignore", RuntimeWarning)
            rewrite = {".obj": _plain_obj, ".glb": _plain_glb}.get(path.suffix.lower())
            plain = None if rewrite is None else rewrite(path.read_bytes())
            source = path if plain is None else io.BytesIO(plain)
            resolver = trimesh.resolvers.FilePathResolver(str(path))
            scene = trimesh.load_scene(source, path.suffix.lower()[1:], resolver, process=False)
            _check_scene(scene)
    except AvmsfError as error:
        raise raising(f"{path}: {error}", **error.attributes | {"file": path}) from error
    except Exception as error:  # trimesh's readers raise whatever their format's parsing raises
        with open(path, "rb") as file:
            commas = bool(_COMMAS.search(file.read(1 << 16)))
        got = "decimal commas" if commas else f"a file that cannot be read ({error})"
        advice = "export it with decimal points" if commas else "export it again"
        raise raising.expected("a mesh or point cloud", got=got, file=path, advice=advice) from error
    return scene


def load_parts(path: Path) -> list[Any]:
    """Return the parts of `load_mesh`, each where it stands; raises CaptureError as that does."""
    scene = load_mesh(path)
    nodes = list(scene.graph.nodes_geometry)
    if len(nodes) == 1:
        transform, name = scene.graph[nodes[0]]
        # A copy of a texture that is cut off would be gray without an error.
        if np.array_equal(transform, np.eye(4)):
            return [scene.geometry[name]]
    parts: list[Any] = list(scene.dump())
    for node, part in zip(nodes, parts, strict=True):
        given = getattr(scene.geometry[scene.graph[node][1]], "visual", None)
        # Copies lack the colors at vertices beside a material.
        if isinstance(given, trimesh.visual.TextureVisuals) and "color" in given.vertex_attributes:
            part.visual.vertex_attributes["color"] = given.vertex_attributes["color"]
    return parts


def _check_size(path: Path) -> None:
    """Raise CaptureError where the file's own counts are beyond the bounds, before anything is built."""
    suffix = path.suffix.lower()
    if not path.is_file():
        raise CaptureError("expected a mesh file, got none")
    if suffix not in MESH_SUFFIXES:
        wanted, got = f"expected a mesh ({', '.join(MESH_SUFFIXES)})", path.suffix or "no suffix"
        raise CaptureError(f"{wanted}, got {got}", name="suffix", value=path.suffix)
    if is_lfs_pointer(path):
        raise CaptureError("expected a mesh, got a Git LFS pointer; run git lfs pull")
    size, most = path.stat().st_size, MAX_GLTF_BYTES if suffix == ".gltf" else MAX_BYTES
    if size > most:
        advice = ", or export it as .glb" if suffix == ".gltf" else ""
        raise CaptureError(
            f"expected at most {most:,} bytes, got {size:,}; reduce the mesh{advice}", name="bytes", value=size
        )
    if suffix == ".gltf":
        _check_gltf(read_json(path, max_bytes=MAX_GLTF_BYTES))


def _check_at_most(most: int, found: int, what: str) -> None:
    if found > most:
        raise CaptureError(f"expected at most {most:,} {what}, got {found:,}; reduce the mesh", name=what, value=found)


def _check_scene(scene: trimesh.Scene) -> None:
    """Raise CaptureError for too many faces, indices that do not exist, and coordinates not finite or too large."""
    names = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    _check_at_most(MAX_PARTS, len(names), "parts")
    _check_at_most(MAX_FACES, sum(len(getattr(scene.geometry[name], "faces", ())) for name in names), "triangles")
    for geometry in scene.geometry.values():
        vertices = np.asarray(getattr(geometry, "vertices", np.zeros((0, 3))), dtype=np.float64)
        _check_at_most(3 * MAX_FACES, len(vertices), "vertices")
        if vertices.shape[1:] != (3,):
            message = f"expected vertices of three coordinates, got {vertices.shape[1]}; export it again"
            raise CaptureError(message, name="vertices", value=list(vertices.shape))
        check_finite_vertices(vertices)
        check_corners(np.asarray(getattr(geometry, "faces", np.zeros((0, 3))), dtype=np.int64), len(vertices))
    pixels = sum(image.width * image.height for geometry in scene.geometry.values() for image in _textures(geometry))
    _check_at_most(MAX_TEXTURE_PIXELS, pixels, "pixels in its textures")
    farthest = 0.0 if scene.bounds is None else float(np.abs(scene.bounds).max())
    if not farthest <= MAX_COORDINATE:
        got = f"{farthest:.3g} (with all parts positioned); export the mesh again"
        message = f"expected coordinates up to {MAX_COORDINATE:g}, got {got}"
        raise CaptureError(message, name="coordinates", value=farthest)


def _textures(geometry: Any) -> list[Image.Image]:
    """Return the pictures of a part's material, which are not decoded yet."""
    material = getattr(getattr(geometry, "visual", None), "material", None)
    named = {} if material is None else {**vars(material), **getattr(material, "_data", {})}
    return [each for each in named.values() if isinstance(each, Image.Image)]


def check_finite_vertices(vertices: np.ndarray) -> None:
    """Raise CaptureError for vertices [points, 3] that are not finite, with the first of them."""
    unfit = ~np.isfinite(vertices).all(axis=1)
    if unfit.any():
        row = int(unfit.argmax())
        value, part = vertices[row].tolist(), f"{int(unfit.sum())} of {len(vertices)} vertices are not finite"
        message = f"vertex {row}: expected finite coordinates, got {value} ({part}); export the mesh again"
        raise CaptureError(message, row=row, name="vertices", value=value)


def check_corners(faces: np.ndarray, vertices: int) -> None:
    """Raise CaptureError where corners of faces [faces, 3] are not indices of this number of vertices."""
    for corner in () if not faces.size else (int(faces.min()), int(faces.max())):
        if not 0 <= corner < vertices:
            got = f"{corner}: the file is truncated or corrupt; export the mesh again"
            message = f"expected corners of faces from 0 to {vertices - 1}, got {got}"
            raise CaptureError(message, name="faces", value=corner)


def check_area(corners: np.ndarray) -> None:
    """Raise CaptureError where no triangle of these corners [faces, 3, 3] has an area."""
    if not np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any():
        message = f"expected triangles with an area, got {len(corners)} without; export the mesh again"
        raise CaptureError(message, name="area", value=0.0)


def _plain_obj(content: bytes) -> bytes | None:
    """Return an OBJ file with single spaces, without a byte-order mark, indices from the first; None if it is so."""
    if not _UNUSUAL.search(content):
        return None
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


def _check_gltf(record: Any) -> None:
    """Raise CaptureError for the JSON of a glTF that is compressed, or whose arrays or nodes are beyond the bounds."""
    for name in record.get("extensionsRequired", ()):
        if name in _COMPRESSED:
            got = f"one compressed by {_COMPRESSED[name]}; export it without"
            raise CaptureError(f"expected a mesh without compression, got {got}", name="extensionsRequired", value=name)
    _check_at_most(MAX_PARTS, len(record.get("nodes", ())), "nodes")
    # Four vectors (position, normal, color, texture) for each corner; an array without a buffer is zeros in memory.
    _check_at_most(12 * MAX_FACES, sum(abs(each["count"]) for each in record.get("accessors", ())), "values")


def _normalized(record: Any) -> list[dict[str, Any]]:
    """Return the accessors whose integers stand for -1 to 1; trimesh reads those of colors if they have 8 bits."""
    primitives = [each for mesh in record.get("meshes", ()) for each in mesh["primitives"]]
    kinds = {(name.startswith("COLOR"), row) for each in primitives for name, row in each["attributes"].items()}
    accessors = record.get("accessors", ())
    used = {row for color, row in kinds if not color or accessors[row]["componentType"] == _USHORT}
    chosen = (accessors[row] for row in sorted(used))
    return [each for each in chosen if each.get("normalized") and each["componentType"] in _INTEGERS]


def _plain_glb(content: bytes) -> bytes | None:
    """Return a binary glTF with normalized integers (KHR_mesh_quantization) as floats; None where it has none."""
    start = 20 + struct.unpack_from("<I", content, 12)[0]
    record = parse_json(content[20:start].decode("utf-8"))
    body = content[start + 8 : start + 8 + struct.unpack_from("<I", content, start)[0]] if len(content) > start else b""
    _check_gltf(record)
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
    return glb_bytes(record, body)


def glb_bytes(record: Mapping[str, Any], body: bytes) -> bytes:
    """Return a binary glTF: a header and two chunks, the JSON and the body, padded to multiples of four bytes."""
    text = json.dumps(record, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
