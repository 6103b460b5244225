"""Mesh files (obj, ply, glb, gltf, stl, off) opened by trimesh, within bounds that are checked before and after.

Every reader of meshes goes through `load_mesh`, so that what it returns has indices that exist and finite coordinates.
"""

import io
import logging
import re
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from avmsf._utils.files import is_lfs_pointer
from avmsf._utils.text_files import parse_json, read_json
from avmsf.errors import AvmsfError, CaptureError
from avmsf.mesh.plain_mesh import expect_uncompressed, plain_mesh

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
MAX_CORNERS = 1_000
"""Corners of one polygon. Modeling programs write caps of at most some hundreds; a polygon of more is cut into
triangles without area."""
MAX_COORDINATE = 1e9
"""Largest coordinate, in the file's unit: a kilometer in micrometers. Its cube is an ordinary number in float32."""
MAX_TEXTURE_PIXELS = 3 * 8192**2
"""Pixels of all textures: three pictures of 8192 x 8192, the largest that graphics cards of all makes take. 0.6 GB."""
_MAX_VALUES = 12 * MAX_FACES
"""Entries of all accessors of a glb: four vectors (position, normal, color, texture) for each corner."""
_COMMAS = re.compile(rb"^\s*(v|vertex)\s+-?[0-9]+,[0-9]", re.MULTILINE)
# Of a missing texture trimesh logs a traceback, which goes to the terminal where nothing else takes it.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def load_mesh(path: Path, *, raising: type[AvmsfError] = CaptureError) -> trimesh.Scene:
    """Return a mesh file's parts and where they stand, as they are in the file; vertices keep their order.

    All vertices are finite and all faces name vertices that exist. Raises `raising` for a file that is missing, larger
    than the bounds above, of another format, or damaged.
    """
    try:
        _expect_small(path)
        with warnings.catch_warnings():
            # numpy's casts of damaged numbers; the results are checked below.
            warnings.simplefilter("ignore", RuntimeWarning)
            plain = plain_mesh(path)
            source = path if plain is None else io.BytesIO(plain)
            resolver = trimesh.resolvers.FilePathResolver(str(path))
            scene = trimesh.load_scene(source, path.suffix.lower()[1:], resolver, process=False)
            _expect_sound(scene)
    except AvmsfError as error:
        raise raising(f"{path}: {error}", file=path, row=error.row, name=error.name, value=error.value) from error
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
    return list(scene.dump())


def _expect_small(path: Path) -> None:
    """Raise CaptureError where the file's own counts are beyond the bounds, before anything is built."""
    suffix = path.suffix.lower()
    if not path.is_file():
        raise CaptureError("expected a mesh file, got none")
    if suffix not in MESH_SUFFIXES:
        raise CaptureError(
            f"expected a mesh ({', '.join(MESH_SUFFIXES)}), got {path.suffix or 'no suffix'}",
            name="suffix",
            value=path.suffix,
        )
    if is_lfs_pointer(path):
        raise CaptureError("expected a mesh, got a Git LFS pointer; run git lfs pull")
    size, most = path.stat().st_size, MAX_GLTF_BYTES if suffix == ".gltf" else MAX_BYTES
    if size > most:
        advice = ", or export it as .glb" if suffix == ".gltf" else ""
        raise CaptureError(
            f"expected at most {most:,} bytes, got {size:,}; reduce the mesh{advice}", name="bytes", value=size
        )
    if suffix == ".obj":
        _expect_small_obj(path)
    elif suffix in (".glb", ".gltf"):
        _expect_small_gltf(read_json(path, max_bytes=MAX_GLTF_BYTES) if suffix == ".gltf" else _glb_record(path))


def _expect_small_obj(path: Path) -> None:
    faces = changes = corners = 0
    materials: set[bytes] = set()
    with open(path, "rb") as file:
        for line in file:
            # A line that ends in a backslash goes on in the next.
            if line.startswith((b"f ", b"f\t")) or corners:
                corners += len(line.split()) - 1
                if not line.rstrip(b"\r\n").endswith(b"\\"):
                    _expect_at_most(MAX_CORNERS, corners, "corners of a face")
                    faces, corners = faces + max(corners - 2, 0), 0
            elif line.startswith(b"usemtl"):
                # Faces of one material become one part, however often the file goes back to it.
                materials.add(line[6:].strip())
                changes += 1
                _expect_at_most(MAX_PARTS, len(materials), "materials")
    _expect_at_most(MAX_FACES, faces, "triangles")
    _expect_at_most(MAX_FACES, changes, "changes of the material")


def _glb_record(path: Path) -> Any:
    """Return the JSON at the beginning of a binary glTF."""
    with open(path, "rb") as file:
        magic, _, _, length, kind = struct.unpack("<4sII I4s", file.read(20))
        if magic != b"glTF" or kind != b"JSON":
            raise CaptureError(f"expected a binary glTF, got a file that begins with {magic!r}", value=magic)
        return parse_json(file.read(min(length, MAX_BYTES)).decode("utf-8"))


def _expect_small_gltf(record: Any) -> None:
    def entries(values: Any, name: str) -> list[dict[str, Any]]:
        found = values.get(name, []) if isinstance(values, dict) else []
        return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []

    expect_uncompressed(record)
    primitives = [len(entries(mesh, "primitives")) for mesh in entries(record, "meshes")]
    used = [node["mesh"] for node in entries(record, "nodes") if isinstance(node.get("mesh"), int)]
    _expect_at_most(MAX_PARTS, len(entries(record, "nodes")), "nodes")
    _expect_at_most(MAX_PARTS, sum(primitives), "primitives")
    _expect_at_most(MAX_PARTS, sum(primitives[row] for row in used if 0 <= row < len(primitives)), "parts")
    values = 0
    for row, each in enumerate(entries(record, "accessors")):
        count = each.get("count")
        if not isinstance(count, int) or count < 0:
            raise CaptureError(
                f"expected a whole number as the count of accessor {row}, got {count!r}; export it again",
                row=row,
                name="count",
                value=count,
            )
        values += count
    _expect_at_most(_MAX_VALUES, values, "values")


def _expect_at_most(most: int, found: int, what: str) -> None:
    if found > most:
        raise CaptureError(f"expected at most {most:,} {what}, got {found:,}; reduce the mesh", name=what, value=found)


def _expect_sound(scene: trimesh.Scene) -> None:
    """Raise CaptureError for too many faces, indices that do not exist, and coordinates not finite or too large."""
    names = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    _expect_at_most(MAX_PARTS, len(names), "parts")
    _expect_at_most(MAX_FACES, sum(len(getattr(scene.geometry[name], "faces", ())) for name in names), "triangles")
    for geometry in scene.geometry.values():
        vertices = np.asarray(getattr(geometry, "vertices", np.zeros((0, 3))), dtype=np.float64)
        _expect_at_most(3 * MAX_FACES, len(vertices), "vertices")
        if vertices.shape[1:] != (3,):
            raise CaptureError(
                f"expected vertices of three coordinates, got {vertices.shape[1]}; export it again",
                name="vertices",
                value=list(vertices.shape),
            )
        expect_finite_vertices(vertices)
        expect_corners(np.asarray(getattr(geometry, "faces", np.zeros((0, 3))), dtype=np.int64), len(vertices))
    pixels = sum(image.width * image.height for geometry in scene.geometry.values() for image in _textures(geometry))
    _expect_at_most(MAX_TEXTURE_PIXELS, pixels, "pixels in its textures")
    farthest = 0.0 if scene.bounds is None else float(np.abs(scene.bounds).max())
    if not farthest <= MAX_COORDINATE:
        raise CaptureError(
            f"expected coordinates up to {MAX_COORDINATE:g}, got {farthest:.3g} (with all parts positioned); export "
            "the mesh again",
            name="coordinates",
            value=farthest,
        )


def _textures(geometry: Any) -> list[Image.Image]:
    """Return the pictures of a part's material, which are not decoded yet."""
    material = getattr(getattr(geometry, "visual", None), "material", None)
    named = {} if material is None else {**vars(material), **getattr(material, "_data", {})}
    return [each for each in named.values() if isinstance(each, Image.Image)]


def expect_finite_vertices(vertices: np.ndarray) -> None:
    """Raise CaptureError for vertices [points, 3] that are not finite, with the first of them."""
    unfit = ~np.isfinite(vertices).all(axis=1)
    if unfit.any():
        row = int(unfit.argmax())
        raise CaptureError(
            f"vertex {row}: expected finite coordinates, got {vertices[row].tolist()} ({int(unfit.sum())} of "
            f"{len(vertices)} vertices are not finite); export the mesh again",
            row=row,
            name="vertices",
            value=vertices[row].tolist(),
        )


def expect_corners(faces: np.ndarray, vertices: int) -> None:
    """Raise CaptureError where corners of faces [faces, 3] are not indices of this number of vertices."""
    for corner in () if not faces.size else (int(faces.min()), int(faces.max())):
        if not 0 <= corner < vertices:
            raise CaptureError(
                f"expected corners of faces from 0 to {vertices - 1}, got {corner}: the file is truncated or corrupt; "
                "export the mesh again",
                name="faces",
                value=corner,
            )
