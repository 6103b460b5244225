"""The header of a `.ply` of Gaussians, and whether the file is long enough for it. Loads no numpy or torch."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from avmsf.errors import SceneError

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
PROPERTIES = {
    "center": ("x", "y", "z"),
    "color": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "rotation": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
NEEDED = tuple(name for names in PROPERTIES.values() for name in names)
"""Properties that every vertex has."""
HIGHER = tuple(f"f_rest_{place}" for place in range(45))
"""Properties of harmonics above degree 0, of which a vertex has the first 0, 9, 24 or 45."""


@dataclass(frozen=True)
class Element:
    """One element of a `.ply`."""

    name: str
    count: int
    """How many of it the file holds."""
    properties: dict[str, str] = field(default_factory=dict)
    """Numpy type of each property without its byte order, in the order of the file; "list" for a list."""


def read_header(path: Path) -> tuple[Element, str, int]:
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
    if len(higher) not in (0, 9, 24, 45) or higher != set(HIGHER[: len(higher)]):
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
    expect_count(path, vertices.count, max(0, size - start) // width)
    return vertices, order, start


def expect_count(path: Path, expected: int, found: int) -> None:
    """Raise SceneError for a file with fewer vertices than its header says."""
    if found < expected:
        advice = "the file is truncated; copy or export it again"
        raise SceneError.expected(f"{expected} vertices", found, file=path, row=found, advice=advice)


def _parse(path: Path, content: bytes) -> tuple[str, list[Element], int]:
    """Return the byte order, the elements and the number of bytes of a header."""
    end = content.find(b"end_header")
    line_end = content.find(b"\n", end, end + len(b"end_header") + 3)
    if not content.startswith(b"ply") or end < 0 or line_end < 0:
        got = "a header without an end" if content.startswith(b"ply") else f"a file that begins with {content[:12]!r}"
        raise SceneError.expected("a .ply of Gaussians", content[:12], got=got, file=path, name="header")
    order, elements, advice = None, list[Element](), "export the file again"
    for row, line in enumerate(content[:end].decode("latin-1").splitlines()[1:], start=2):
        match line.split():
            case ["format", word, *_] if word in _ORDERS:
                order = _ORDERS[word]
            case ["element", name, count] if count.isdecimal() and len(count) <= _MAX_DIGITS:
                elements.append(Element(name, int(count)))
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


def _find_gaussians(path: Path, elements: Sequence[Element]) -> Element:
    """Return the element that holds the Gaussians. Raises SceneError, which describes the file, for other files."""
    named = {element.name: element for element in elements}
    vertices, faces = (named.get(name, Element(name, 0)) for name in ("vertex", "face"))
    properties = vertices.properties.keys()
    missing = [name for name in NEEDED if name not in properties]
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
