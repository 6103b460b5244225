"""Gaussians in the `.ply` layout of 3DGS, which most viewers and trainers of Gaussians read and write.

One element `vertex` with the properties x y z, nx ny nz (zero, and not read), f_dc_0..2, f_rest_0.. (channel by
channel: all of red, then green, then blue), opacity (a logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z). The
header is read and checked first, with whether the file is long enough for it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped

from avmsf._utils.files import write_whole
from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"} | {
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""The format's types as numpy names them."""
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""The byte order of each format as numpy writes it; none for text."""
_MAX_HEADER_BYTES = 1 << 16
"""A file whose header has not ended by then is no .ply of Gaussians."""
_MAX_DIGITS = 18
"""Digits of a count, which then fits into 64 bits."""
_CENTER, _COLOR, _OPACITY = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("opacity",)
_SCALES, _ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*_CENTER, *_COLOR, *_OPACITY, *_SCALES, *_ROTATION)
"""Properties that every vertex has."""
_HIGHER = tuple(f"f_rest_{place}" for place in range(45))
"""Properties of harmonics above degree 0, of which a vertex has the first 0, 9, 24 or 45."""


@dataclass(frozen=True)
class _Element:
    """One element of a `.ply`."""

    name: str
    count: int
    """How many of it the file holds."""
    properties: dict[str, str] = field(default_factory=dict)
    """Numpy type of each property without its byte order, in the order of the file; "list" for a list."""


def _read_header(path: Path) -> tuple[_Element, str, int]:
    """Return a file's Gaussians, the byte order as numpy writes it, and where they start, from the header alone.

    The order of a text file is empty, and its start counts words, else bytes. Raises `SceneError` for a file that is
    missing or no `.ply` of Gaussians, saying what it is, and for a binary one that ends before its last vertex; the
    length of a text file is not known from its header.
    """
    try:
        with path.open("rb") as file:
            content, size = file.read(_MAX_HEADER_BYTES), path.stat().st_size
    except OSError as error:
        got = str(error.strerror or error)
        raise SceneError.expected("a .ply of Gaussians that can be read", got=got, file=path) from error
    order, elements, length = _parse(path, content)
    vertices = _find_gaussians(path, elements)
    higher = {name for name in vertices.properties if name.startswith("f_rest_")}
    if len(higher) not in (0, 9, 24, 45) or higher != set(_HIGHER[: len(higher)]):
        wanted = "0, 9, 24 or 45 coefficients f_rest_* (degrees 0 to 3)"
        raise SceneError.expected(wanted, len(higher), file=path, name="f_rest")
    if not vertices.count:
        raise SceneError.expected("Gaussians", 0, file=path, name="vertex", advice="fit them to the views again")
    before = elements[: elements.index(vertices)]
    if any("list" in element.properties.values() for element in (*before, vertices)):
        wanted, advice = "single numbers before and in the vertices", "export it with 3DGS"
        raise SceneError.expected(wanted, got="lists", file=path, name="list", advice=advice)
    if not order:
        words = sum(element.count * len(element.properties) for element in before)
        return vertices, order, len(content[:length].split()) + words
    *others, width = (sum(int(kind[1:]) for kind in element.properties.values()) for element in (*before, vertices))
    start = length + sum(element.count * each for element, each in zip(before, others, strict=True))
    _expect_count(path, vertices.count, max(0, size - start) // width)
    return vertices, order, start


def _expect_count(path: Path, expected: int, found: int) -> None:
    """Raise SceneError for a file with fewer vertices than its header says."""
    if found < expected:
        advice = "the file is truncated; copy or export it again"
        raise SceneError.expected(f"{expected} vertices", found, file=path, row=found, advice=advice)


def _parse(path: Path, content: bytes) -> tuple[str, list[_Element], int]:
    """Return the byte order, the elements and the number of bytes of a header."""
    end = content.find(b"end_header")
    line_end = content.find(b"\n", end, end + len(b"end_header") + 3)
    if not content.startswith(b"ply") or end < 0 or line_end < 0:
        got = "a header without an end" if content.startswith(b"ply") else f"a file that begins with {content[:12]!r}"
        raise SceneError.expected("a .ply of Gaussians", content[:12], got=got, file=path, name="header")
    order, elements, advice = None, list[_Element](), "export the file again"
    for row, line in enumerate(content[:end].decode("latin-1").splitlines()[1:], start=2):
        match line.split():
            case ["format", word, *_] if word in _ORDERS:
                order = _ORDERS[word]
            case ["element", name, count] if count.isdecimal() and len(count) <= _MAX_DIGITS:
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, name] if elements and name not in elements[-1].properties:
                elements[-1].properties[name] = "list"
            case ["property", kind, name] if elements and kind in _TYPES and name not in elements[-1].properties:
                elements[-1].properties[name] = _TYPES[kind]
            case ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                wanted = "a header line of .ply 1.0"
                raise SceneError.expected(wanted, line, file=path, row=row, name="header", advice=advice)
    if order is None:
        wanted = "a format in the header, ascii or binary"
        raise SceneError.expected(wanted, file=path, name="format", advice=advice)
    return order, elements, line_end + 1


def _find_gaussians(path: Path, elements: Sequence[_Element]) -> _Element:
    """Return the element that holds the Gaussians. Raises SceneError, which describes the file, for other files."""
    named = {element.name: element for element in elements}
    vertices, faces = (named.get(name, _Element(name, 0)) for name in ("vertex", "face"))
    properties = vertices.properties.keys()
    missing = [name for name in _NEEDED if name not in properties]
    value: object
    if any(name.startswith("packed_") for element in elements for name in element.properties):
        got, name, value, advice = "compressed ones", "compression", list(named), "export them uncompressed"
    elif not missing:
        return vertices
    elif {"opacity", "f_dc_0"} & properties:
        got, name, value, advice = f"Gaussians without {', '.join(missing)}", missing[0], missing, ""
    elif faces.count:
        got, name, value = f"a mesh of {faces.count} faces", "face", faces.count
        advice = "use it as the capture's surface"
    elif {"x", "y", "z"} <= properties:
        got, name, value = f"a point cloud of {vertices.count} points", "vertex", vertices.count
        advice = "use it as the capture's surface, or as initial points"
    else:
        got, name, value, advice = f"a .ply of {', '.join(named) or 'nothing'}", "elements", list(named), ""
    wanted = "uncompressed Gaussians as 3DGS writes them"
    raise SceneError.expected(wanted, value, got=got, file=path, name=name, advice=advice)


def write_splats(cloud: GaussianCloud, path: str | Path) -> None:
    """Write the Gaussians as 3DGS does: float32, binary, little endian. Raises `SceneError` where that cannot be."""
    write_whole(Path(path), splat_bytes(cloud), raising=SceneError)


def splat_bytes(cloud: GaussianCloud) -> bytes:
    """Return the content of the file that `write_splats` writes."""
    cloud, count = cloud.detach().to("cpu"), len(cloud)
    higher = cloud.harmonics[:, 1:].mT.reshape(count, -1)
    columns = [cloud.centers, torch.zeros(count, 3), cloud.harmonics[:, 0], higher, cloud.logit_opacities[:, None]]
    table = torch.cat([*columns, cloud.log_scales, cloud.rotations], dim=1).numpy().astype("<f4")
    names = [*_CENTER, "nx", "ny", "nz", *_COLOR, *_HIGHER[: higher.shape[1]], *_OPACITY, *_SCALES, *_ROTATION]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def holds_gaussians(path: Path) -> bool:
    """Return whether there is a .ply whose header has the properties of Gaussians."""
    if path.suffix.lower() != ".ply" or not path.is_file():
        return False
    with path.open("rb") as file:
        header, _, _ = file.read(_MAX_HEADER_BYTES).partition(b"end_header")
    return b"scale_0" in header and b"rot_0" in header


def read_splats(path: str | Path) -> GaussianCloud:
    """Read Gaussians from a 3DGS `.ply`, text or binary of either byte order; other properties are ignored.

    Raises `SceneError`, which describes the file, for one that is missing, no .ply, a mesh, a point cloud, compressed
    or truncated, or holds numbers that are not finite.
    """
    path = Path(path)
    columns = _read_columns(path)
    higher = _HIGHER[: len(columns.keys() & set(_HIGHER))]
    for name in (*_NEEDED, *higher):
        # Text and float64 hold numbers that are infinite as float32, in which Gaussians are computed.
        wrong = np.flatnonzero(~(np.abs(columns[name]) <= np.finfo(np.float32).max))
        if len(wrong):
            row, value = int(wrong[0]), float(columns[name][wrong[0]])
            wanted = f"a finite float32 number as {name} of each vertex"
            raise SceneError.expected(wanted, value, file=path, row=row, name=name)

    def stacked(*names: str) -> Float[torch.Tensor, "points names"]:
        values = np.stack([columns[name] for name in names], axis=1)
        return torch.from_numpy(values.astype(np.float32, order="C"))

    rotations = stacked(*_ROTATION)
    still = torch.nonzero((rotations == 0).all(1))
    if len(still):
        wanted = "a quaternion as the rotation of each vertex"
        raise SceneError.expected(wanted, [0.0] * 4, file=path, row=int(still[0]), name=_ROTATION[0])
    above = len(higher) // 3
    by_channel = [(name, *higher[place * above : (place + 1) * above]) for place, name in enumerate(_COLOR)]
    harmonics = torch.stack([stacked(*names) for names in by_channel], dim=2)
    return GaussianCloud(stacked(*_CENTER), rotations, stacked(*_SCALES), stacked(*_OPACITY)[:, 0], harmonics)


def _read_columns(path: Path) -> Mapping[str, Shaped[np.ndarray, " points"]]:
    """Return the values of each property of the Gaussians. Raises SceneError for words and missing rows in a text."""
    vertices, order, start = _read_header(path)
    if order:
        kind = np.dtype([(name, order + kind) for name, kind in vertices.properties.items()])
        table = np.fromfile(path, kind, vertices.count, offset=start)
        return {name: table[name] for name in vertices.properties}
    width = len(vertices.properties)
    words = path.read_bytes().split()[start : start + vertices.count * width]
    _expect_count(path, vertices.count, len(words) // width)
    try:
        rows = np.array(words, dtype="S").astype(np.float64).reshape(vertices.count, width)
    except ValueError as error:
        raise SceneError.expected("numbers in the vertices", got=str(error), file=path, name="vertex") from error
    return dict(zip(vertices.properties, rows.T, strict=True))
