"""Gaussians in the `.ply` layout of 3DGS, which most viewers and trainers of Gaussians read and write.

One element `vertex` with the properties x y z, nx ny nz (zero, and not read), f_dc_0..2, f_rest_0.. (channel by
channel: all of red, then green, then blue), opacity (a logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z).
"""

from pathlib import Path

import numpy as np
import torch

from avmsf._utils.files import write_whole
from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply_header import (
    MIDDLE,
    NEEDED,
    OPACITY,
    ORDERS,
    ROTATION,
    SCALES,
    ZEROTH,
    Element,
    Header,
    expect_gaussians,
    parse_header,
    truncated,
    unreadable,
    vertices_start,
)


def write_splats(cloud: GaussianCloud, path: str | Path) -> None:
    """Write the Gaussians as 3DGS does: float32, binary, little endian. Raises `SceneError` where that cannot be."""
    rest = cloud.harmonics[:, 1:].detach().mT.reshape(len(cloud), -1)
    columns = {
        **dict(zip(MIDDLE, cloud.centers.detach().T, strict=True)),
        **{name: torch.zeros(len(cloud)) for name in ("nx", "ny", "nz")},
        **dict(zip(ZEROTH, cloud.harmonics[:, 0].detach().T, strict=True)),
        **{f"f_rest_{place}": column for place, column in enumerate(rest.T)},
        "opacity": cloud.logit_opacities.detach(),
        **dict(zip(SCALES, cloud.log_scales.detach().T, strict=True)),
        **dict(zip(ROTATION, cloud.rotations.detach().T, strict=True)),
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
        raise unreadable(path, error) from error
    header = parse_header(path, content)
    vertices = expect_gaussians(path, header)
    table = _table(path, content, header, vertices)
    count = sum(name.startswith("f_rest_") for name in table.dtype.names or ())
    others = tuple(f"f_rest_{place}" for place in range(count))
    for name in (*NEEDED, *others):
        # Text and float64 hold numbers that are infinite as float32, in which Gaussians are computed.
        wrong = np.flatnonzero(~(np.abs(table[name]) <= np.finfo(np.float32).max))
        if len(wrong):
            row, value = int(wrong[0]), float(table[name][wrong[0]])
            raise SceneError.expected(
                f"a finite float32 number as {name} of each vertex", value, file=path, row=row, name=name
            )
    columns = [_columns(table, names) for names in (MIDDLE, ROTATION, SCALES, OPACITY, ZEROTH)]
    if not bool((columns[1] != 0).any(1).all()):
        row = int((columns[1] == 0).all(1).nonzero()[0])
        raise SceneError.expected(
            "a quaternion as the rotation of each vertex", [0.0] * 4, file=path, row=row, name=ROTATION[0]
        )
    rest = _columns(table, others)
    harmonics = torch.cat([columns[4][:, None], rest.reshape(len(rest), 3, count // 3).mT], dim=1).contiguous()
    return GaussianCloud(columns[0], columns[1], columns[2], columns[3][:, 0], harmonics)


def _table(path: Path, content: bytes, header: Header, vertices: Element) -> np.ndarray:
    """Return the vertices, one field for each property. Raises SceneError where some are missing."""
    start = vertices_start(path, header, vertices, size=len(content))
    if header.order == "ascii":
        before = header.elements[: header.elements.index(vertices)]
        return _text_table(path, content[start:], before, vertices)
    mark = ORDERS[header.order]
    kind = np.dtype([(name, mark + kind) for name, kind in vertices.properties])
    return np.frombuffer(content, kind, vertices.count, start)


def _text_table(path: Path, content: bytes, before: tuple[Element, ...], vertices: Element) -> np.ndarray:
    start = sum(each.count * len(each.properties) for each in before)
    width = len(vertices.properties)
    words = content.split()[start : start + vertices.count * width]
    if len(words) < vertices.count * width:
        raise truncated(path, len(words) // width, vertices.count)
    try:
        values = np.array(words, dtype="S").astype(np.float64).reshape(vertices.count, width)
    except ValueError as error:
        raise SceneError(f"{path}: expected numbers in the vertices ({error})", file=path, name="vertex") from error
    table = np.empty(vertices.count, [(name, "f8") for name, _ in vertices.properties])
    for place, (name, _) in enumerate(vertices.properties):
        table[name] = values[:, place]
    return table


def _columns(table: np.ndarray, names: tuple[str, ...]) -> torch.Tensor:
    values = np.zeros((len(table), len(names)), dtype=np.float32)
    for place, name in enumerate(names):
        values[:, place] = table[name]
    return torch.from_numpy(values)
