"""The header of a `.ply` of Gaussians, and whether the file is long enough for it. Loads no numpy or torch."""

from dataclasses import dataclass, replace
from pathlib import Path

from avmsf.errors import SceneError

_WORDS = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
_KINDS = "i1 u1 i2 u2 i4 u4 f4 f8 i1 u1 i2 u2 i4 u4 f4 f8"
_TYPES = dict(zip(_WORDS.split(), _KINDS.split(), strict=True))
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Formats, and the byte order of each as numpy writes it."""
_LONGEST_HEADER = 1 << 16
"""Bytes; a file whose header has not ended by then is no .ply of Gaussians."""
_MAX_DIGITS = 18
"""Digits of a count, which then fits into 64 bits."""
MIDDLE, ZEROTH, OPACITY = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("opacity",)
SCALES, ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
NEEDED = (*MIDDLE, *ZEROTH, *OPACITY, *SCALES, *ROTATION)
"""Properties that every vertex has."""


@dataclass(frozen=True)
class Element:
    """One element of a `.ply`."""

    name: str
    count: int
    """How many of it the file holds."""
    properties: tuple[tuple[str, str], ...]
    """Name and numpy type of each; type "list" for a list."""


@dataclass(frozen=True)
class Header:
    """A parsed header."""

    order: str
    """One of `ORDERS`."""
    elements: tuple[Element, ...]
    length: int
    """Bytes up to the data."""


def expect_splats(path: Path) -> None:
    """Raise `SceneError` for a file that is no `.ply` of Gaussians, or ends before its last vertex.

    Only the header is read. The length of a text file is not known from it.
    """
    try:
        with path.open("rb") as file:
            content, size = file.read(_LONGEST_HEADER), path.stat().st_size
    except OSError as error:
        raise unreadable(path, error) from error
    header = parse_header(path, content)
    vertices_start(path, header, expect_gaussians(path, header), size=size)


def parse_header(path: Path, content: bytes) -> Header:
    """Return the parsed header. Raises SceneError for other files than .ply."""
    end = content.find(b"end_header", 0, _LONGEST_HEADER)
    line_end = content.find(b"\n", end, end + len(b"end_header") + 3)
    if not content.startswith(b"ply") or end < 0 or line_end < 0:
        found = "a header without an end" if content.startswith(b"ply") else f"a file that begins with {content[:12]!r}"
        raise SceneError.expected("a .ply of Gaussians", content[:12], got=found, file=path, name="header")
    order, elements = None, list[Element]()
    for row, line in enumerate(content[:end].decode("latin-1").splitlines()[1:], start=2):
        match line.split():
            case ["format", word, *_] if word in ORDERS:
                order = word
            case ["element", name, count] if count.isdecimal() and len(count) <= _MAX_DIGITS:
                elements.append(Element(name, int(count), ()))
            case ["property", "list", _, _, name] if elements:
                elements[-1] = replace(elements[-1], properties=(*elements[-1].properties, (name, "list")))
            case ["property", word, name] if elements and word in _TYPES:
                elements[-1] = replace(elements[-1], properties=(*elements[-1].properties, (name, _TYPES[word])))
            case ["comment", *_] | ["obj_info", *_] | []:
                pass
            case _:
                raise SceneError.expected(
                    "a header line of .ply 1.0", line, file=path, row=row, name="header", advice="export the file again"
                )
    if order is None:
        raise SceneError.expected(
            "a format in the header, ascii or binary", file=path, name="format", advice="export the file again"
        )
    return Header(order, tuple(elements), line_end + 1)


def expect_gaussians(path: Path, header: Header) -> Element:
    """Return the element that holds the Gaussians. Raises SceneError, which describes the file, for other files."""
    named = {element.name: element for element in header.elements}
    vertices, faces = named.get("vertex"), named.get("face")
    found = [] if vertices is None else [name for name, _ in vertices.properties]
    missing = [name for name in NEEDED if name not in found]
    packed = any(name.startswith("packed_") for element in header.elements for name, _ in element.properties)
    if vertices is not None and not missing and not packed:
        rest = sorted(name for name in found if name.startswith("f_rest_"))
        if len(rest) not in (0, 9, 24, 45) or rest != sorted(f"f_rest_{place}" for place in range(len(rest))):
            raise SceneError.expected(
                "0, 9, 24 or 45 coefficients f_rest_* (degrees 0 to 3)", len(rest), file=path, name="f_rest"
            )
        if not vertices.count:
            raise SceneError.expected("Gaussians", 0, file=path, name="vertex", advice="fit them to the views again")
        return vertices
    value: object
    got, name, value, advice = f"a .ply of {', '.join(named) or 'nothing'}", "elements", list(named), ""
    if packed:
        got, name, advice = f"compressed ones ({', '.join(named)})", "compression", "export them uncompressed"
    elif "opacity" in found or "f_dc_0" in found:
        got, name, value = f"Gaussians without {', '.join(missing)}", missing[0], missing
    elif faces is not None and faces.count:
        got, name, value = f"a mesh of {faces.count} faces", "face", faces.count
        advice = "use it as the capture's surface"
    elif vertices is not None and {"x", "y", "z"} <= set(found):
        got, name, value = f"a point cloud of {vertices.count} points", "vertex", vertices.count
        advice = "use it as the capture's surface, or as initial points"
    raise SceneError.expected(
        "uncompressed Gaussians as 3DGS writes them", value, got=got, file=path, name=name, advice=advice
    )


def vertices_start(path: Path, header: Header, vertices: Element, *, size: int) -> int:
    """Return the byte at which the vertices begin in a file of `size` bytes; of a text file where the data begins.

    Raises SceneError for lists up to there, and for a binary file that ends before the last vertex.
    """
    before = header.elements[: header.elements.index(vertices)]
    if any(kind == "list" for element in (*before, vertices) for _, kind in element.properties):
        wanted, advice = "single numbers before and in the vertices", "export it with 3DGS"
        raise SceneError.expected(wanted, got="lists", file=path, name="list", advice=advice)
    if header.order == "ascii":
        return header.length
    start = header.length + sum(each.count * _bytes_of(each) for each in before)
    whole = max(0, size - start) // _bytes_of(vertices)
    if whole < vertices.count:
        raise truncated(path, whole, vertices.count)
    return start


def _bytes_of(element: Element) -> int:
    return sum(int(kind[1:]) for _, kind in element.properties)


def unreadable(path: Path, error: OSError) -> SceneError:
    """Return the error for a file that the system does not read."""
    return SceneError.expected("a .ply of Gaussians that can be read", got=str(error.strerror or error), file=path)


def truncated(path: Path, found: int, expected: int) -> SceneError:
    """Return the error for a file that has fewer vertices than its header says."""
    return SceneError.expected(
        f"{expected} vertices", found, file=path, row=found, advice="the file is truncated; copy or export it again"
    )
