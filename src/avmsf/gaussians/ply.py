"""Gaussians in the `.ply` layout of 3DGS, which most viewers and trainers of Gaussians read and write.

One element `vertex` with the properties x y z, nx ny nz (zero, and not read), f_dc_0..2, f_rest_0.. (channel by
channel: all of red, then green, then blue), opacity (a logit), scale_0..2 (logarithms), rot_0..3 (w, x, y, z).
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped

from avmsf._utils.files import write_whole
from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply_header import HIGHER, NEEDED, PROPERTIES, expect_count, read_header

_CENTER, _COLOR, _OPACITY, _SCALES, _ROTATION = PROPERTIES.values()


def write_splats(cloud: GaussianCloud, path: str | Path) -> None:
    """Write the Gaussians as 3DGS does: float32, binary, little endian. Raises `SceneError` where that cannot be."""
    write_whole(Path(path), splat_bytes(cloud), raising=SceneError)


def splat_bytes(cloud: GaussianCloud) -> bytes:
    """Return the content of the file that `write_splats` writes."""
    cloud, count = cloud.detach().to("cpu"), len(cloud)
    higher = cloud.harmonics[:, 1:].mT.reshape(count, -1)
    columns = [cloud.centers, torch.zeros(count, 3), cloud.harmonics[:, 0], higher, cloud.logit_opacities[:, None]]
    table = torch.cat([*columns, cloud.log_scales, cloud.rotations], dim=1).numpy().astype("<f4")
    names = [*_CENTER, "nx", "ny", "nz", *_COLOR, *HIGHER[: higher.shape[1]], *_OPACITY, *_SCALES, *_ROTATION]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def holds_gaussians(path: Path) -> bool:
    """Return whether there is a .ply whose header has the properties of Gaussians."""
    if path.suffix.lower() != ".ply" or not path.is_file():
        return False
    with path.open("rb") as file:
        header, _, _ = file.read(1 << 16).partition(b"end_header")
    return b"scale_0" in header and b"rot_0" in header


def read_splats(path: str | Path) -> GaussianCloud:
    """Read Gaussians from a 3DGS `.ply`, text or binary of either byte order; other properties are ignored.

    Raises `SceneError`, which describes the file, for one that is missing, no .ply, a mesh, a point cloud, compressed
    or truncated, or holds numbers that are not finite.
    """
    path = Path(path)
    columns = _read_columns(path)
    higher = HIGHER[: len(columns.keys() & set(HIGHER))]
    for name in (*NEEDED, *higher):
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
    vertices, order, start = read_header(path)
    if order:
        kind = np.dtype([(name, order + kind) for name, kind in vertices.properties.items()])
        table = np.fromfile(path, kind, vertices.count, offset=start)
        return {name: table[name] for name in vertices.properties}
    width = len(vertices.properties)
    words = path.read_bytes().split()[start : start + vertices.count * width]
    expect_count(path, vertices.count, len(words) // width)
    try:
        rows = np.array(words, dtype="S").astype(np.float64).reshape(vertices.count, width)
    except ValueError as error:
        raise SceneError.expected("numbers in the vertices", got=str(error), file=path, name="vertex") from error
    return dict(zip(vertices.properties, rows.T, strict=True))
