"""Gaussians in the `.ply` layout of 3DGS, which most viewers and trainers of Gaussians read and write.

One element `vertex` with the properties x y z, nx ny nz (zero, and not read), f_dc_0..2, f_rest_0.. (channel by
channel: all of red, then green, then blue), opacity (a logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from avmsf.errors import SceneError
from avmsf.files import write_whole
from avmsf.scene.gaussians import GaussianCloud

_WORDS = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
_KINDS = "i1 u1 i2 u2 i4 u4 f4 f8 i1 u1 i2 u2 i4 u4 f4 f8"
_TYPES = dict(zip(_WORDS.split(), _KINDS.split(), strict=True))
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LONGEST_HEADER = 1 << 16
"""Bytes; a file whose header has not ended by then is no .ply of Gaussians."""
_MAX_DIGITS = 18
"""Digits of a count, which then fits into 64 bits."""
_MIDDLE, _ZEROTH, _OPACITY = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("opacity",)
_SCALES, _ROTATION = ("scale_0", "scale_1", "scale_2"), ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*_MIDDLE, *_ZEROTH, *_OPACITY, *_SCALES, *_ROTATION)


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    """Name and numpy type of each; type "list" for a list."""


@dataclass(frozen=True)
class _Header:
    order: str
    elements: tuple[_Element, ...]
    length: int
    """Bytes up to the data."""


def write_splats(cloud: GaussianCloud, path: str | Path) -> None:
    """Write the Gaussians as 3DGS does: float32, binary, little endian. Raises `SceneError` where that cannot be."""
    rest = cloud.harmonics[:, 1:].detach().mT.reshape(len(cloud), -1)
    columns = {
        **dict(zip(_MIDDLE, cloud.centers.detach().T, strict=True)),
        **{name: torch.zeros(len(cloud)) for name in ("nx", "ny", "nz")},
        **dict(zip(_ZEROTH, cloud.harmonics[:, 0].detach().T, strict=True)),
        **{f"f_rest_{place}": column for place, column in enumerate(rest.T)},
        "opacity": cloud.logit_opacities.detach(),
        **dict(zip(_SCALES, cloud.log_scales.detach().T, strict=True)),
        **dict(zip(_ROTATION, cloud.rotations.detach().T, strict=True)),
    }
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property float {name}" for name in columns] + ["end_header", ""]
    table = np.stack([column.cpu().numpy() for column in columns.values()], axis=1)
    content = "\n".join(header).encode("ascii") + table.astype("<f4").tobytes()
    write_whole(Path(path), lambda place: place.write_bytes(content), raising=SceneError)


def read_splats(path: str | Path) -> GaussianCloud:
    """Read Gaussians from a 3DGS `.ply`, text or binary of either byte order; other properties are ignored.

    Raises `SceneError`, which describes the file, for one that is missing, no .ply, a mesh, a point cloud, compressed
    or truncated, or holds numbers that are not finite.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SceneError(
            f"{path}: expected a .ply of Gaussians, got a file that cannot be read ({error.strerror or error})",
            file=path,
        ) from error
    header = _header(path, content)
    vertices = _expect_gaussians(path, header)
    table = _table(path, content, header, vertices)
    count = sum(name.startswith("f_rest_") for name in table.dtype.names or ())
    others = tuple(f"f_rest_{place}" for place in range(count))
    for name in (*_NEEDED, *others):
        # Text and float64 hold numbers that are infinite as float32, in which Gaussians are computed.
        wrong = np.flatnonzero(~(np.abs(table[name]) <= np.finfo(np.float32).max))
        if len(wrong):
            row, value = int(wrong[0]), float(table[name][wrong[0]])
            raise SceneError(
                f"{path}, vertex {row}: expected a finite float32 number as {name}, got {value} ({len(wrong)} vertices "
                "of this kind); export the Gaussians again without these",
                file=path,
                row=row,
                name=name,
                value=value,
            )
    columns = [_columns(table, names) for names in (_MIDDLE, _ROTATION, _SCALES, _OPACITY, _ZEROTH)]
    if not bool((columns[1] != 0).any(1).all()):
        row = int((columns[1] == 0).all(1).nonzero()[0])
        raise SceneError(
            f"{path}, vertex {row}: expected a quaternion as rotation, got 0, 0, 0, 0; export it again",
            file=path,
            row=row,
            name=_ROTATION[0],
            value=[0.0] * 4,
        )
    rest = _columns(table, others)
    harmonics = torch.cat([columns[4][:, None], rest.reshape(len(rest), 3, count // 3).mT], dim=1).contiguous()
    return GaussianCloud(columns[0], columns[1], columns[2], columns[3][:, 0], harmonics)


def _header(path: Path, content: bytes) -> _Header:
    """Return the parsed header. Raises SceneError for other files than .ply."""
    end = content.find(b"end_header", 0, _LONGEST_HEADER)
    line_end = content.find(b"\n", end, end + len(b"end_header") + 3)
    if not content.startswith(b"ply") or end < 0 or line_end < 0:
        found = "a header without an end" if content.startswith(b"ply") else f"a file that begins with {content[:12]!r}"
        raise SceneError.expected(
            "a .ply of Gaussians as 3DGS writes it", content[:12], got=str(found), file=path, name="header"
        )
    order, elements = None, list[_Element]()
    for row, line in enumerate(content[:end].decode("latin-1").splitlines()[1:], start=2):
        match line.split():
            case ["format", word, *_] if word in _ORDERS:
                order = word
            case ["element", name, count] if count.isdecimal() and len(count) <= _MAX_DIGITS:
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", _, _, name] if elements:
                elements[-1] = _with(elements[-1], name, "list")
            case ["property", word, name] if elements and word in _TYPES:
                elements[-1] = _with(elements[-1], name, _TYPES[word])
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
    return _Header(order, tuple(elements), line_end + 1)


def _with(element: _Element, name: str, kind: str) -> _Element:
    return _Element(element.name, element.count, (*element.properties, (name, kind)))


def _expect_gaussians(path: Path, header: _Header) -> _Element:
    """Return the element that holds the Gaussians. Raises SceneError, which describes the file, for other files."""
    named = {element.name: element for element in header.elements}
    names = [name for element in header.elements for name, _ in element.properties]
    if any(name.startswith("packed_") for name in names):
        raise SceneError(
            f"{path}: expected uncompressed Gaussians as 3DGS writes them, got compressed ones ({', '.join(named)}); "
            "export them uncompressed",
            file=path,
            name="compression",
            value=list(named),
        )
    vertices = named.get("vertex")
    found = [] if vertices is None else [name for name, _ in vertices.properties]
    missing = [name for name in _NEEDED if name not in found]
    if vertices is not None and not missing:
        degrees = {3 * (degree + 1) ** 2 - 3: degree for degree in range(4)}
        rest = sorted(name for name in found if name.startswith("f_rest_"))
        if len(rest) not in degrees or rest != sorted(f"f_rest_{place}" for place in range(len(rest))):
            raise SceneError.expected(
                "0, 9, 24 or 45 coefficients f_rest_* (degrees 0 to 3)", len(rest), file=path, name="f_rest"
            )
        if not vertices.count:
            raise SceneError(
                f"{path}: expected Gaussians, got none; fit them to the views again", file=path, name="vertex", value=0
            )
        return vertices
    if "opacity" in found or "f_dc_0" in found:
        raise SceneError(
            f"{path}: expected the properties that 3DGS writes, got Gaussians without {', '.join(missing)}",
            file=path,
            name=missing[0],
            value=missing,
        )
    if "face" in named and named["face"].count:
        raise SceneError(
            f"{path}: expected Gaussians, got a mesh of {named['face'].count} faces; use it as the capture's surface",
            file=path,
            name="face",
            value=named["face"].count,
        )
    if vertices is not None and {"x", "y", "z"} <= set(found):
        raise SceneError(
            f"{path}: expected Gaussians, got a point cloud of {vertices.count} points; use it as the capture's "
            "surface, or as initial points",
            file=path,
            name="vertex",
            value=vertices.count,
        )
    raise SceneError(
        f"{path}: expected the Gaussians that 3DGS writes, got a .ply of {', '.join(named) or 'nothing'}",
        file=path,
        name="elements",
        value=list(named),
    )


def _table(path: Path, content: bytes, header: _Header, vertices: _Element) -> np.ndarray:
    """Return the vertices, one field for each property. Raises SceneError where some are missing."""
    before = header.elements[: header.elements.index(vertices)]
    if any(kind == "list" for element in (*before, vertices) for _, kind in element.properties):
        raise SceneError(
            f"{path}: expected single numbers before and in the vertices, got lists; export it with 3DGS",
            file=path,
            name="list",
        )
    if header.order == "ascii":
        return _text_table(path, content[header.length :], before, vertices)
    mark = _ORDERS[header.order]
    types = [np.dtype([(name, mark + kind) for name, kind in each.properties]) for each in (*before, vertices)]
    start = header.length + sum(each.count * kind.itemsize for each, kind in zip(before, types, strict=False))
    whole = max(0, len(content) - start) // types[-1].itemsize
    if whole < vertices.count:
        raise _short(path, whole, vertices.count)
    return np.frombuffer(content, types[-1], vertices.count, start)


def _text_table(path: Path, content: bytes, before: tuple[_Element, ...], vertices: _Element) -> np.ndarray:
    start = sum(each.count * len(each.properties) for each in before)
    width = len(vertices.properties)
    words = content.split()[start : start + vertices.count * width]
    if len(words) < vertices.count * width:
        raise _short(path, len(words) // width, vertices.count)
    try:
        values = np.array(words, dtype="S").astype(np.float64).reshape(vertices.count, width)
    except ValueError as error:
        raise SceneError(f"{path}: expected numbers in the vertices ({error})", file=path, name="vertex") from error
    table = np.empty(vertices.count, [(name, "f8") for name, _ in vertices.properties])
    for place, (name, _) in enumerate(vertices.properties):
        table[name] = values[:, place]
    return table


def _short(path: Path, found: int, expected: int) -> SceneError:
    return SceneError.expected(
        f"{expected} vertices", found, file=path, row=found, advice="the file is truncated; copy or export it again"
    )


def _columns(table: np.ndarray, names: tuple[str, ...]) -> torch.Tensor:
    values = np.zeros((len(table), len(names)), dtype=np.float32)
    for place, name in enumerate(names):
        values[:, place] = table[name]
    return torch.from_numpy(values)
