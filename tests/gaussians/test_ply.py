import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from avmsf.errors import SceneError
from avmsf.gaussians.cloud import GaussianCloud
from avmsf.gaussians.ply import holds_gaussians, read_splats, write_splats
from factories.clouds import random_cloud
from factories.raising import raises

ORDER = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"] + [
    f"rot_{place}" for place in range(4)
]


def _cloud(degree: int = 1) -> GaussianCloud:
    return random_cloud(7, degree=degree)


def _columns(cloud: GaussianCloud) -> dict[str, np.ndarray]:
    """The properties of a cloud of degree 1, spelt out."""
    columns = {name: cloud.centers[:, place] for place, name in enumerate("xyz")}
    columns |= {f"f_dc_{channel}": cloud.harmonics[:, 0, channel] for channel in range(3)}
    for channel in range(3):
        for place in range(3):
            columns[f"f_rest_{3 * channel + place}"] = cloud.harmonics[:, 1 + place, channel]
    columns |= {"opacity": cloud.logit_opacities}
    columns |= {f"scale_{place}": cloud.log_scales[:, place] for place in range(3)}
    columns |= {f"rot_{place}": cloud.rotations[:, place] for place in range(4)}
    return {name: column.numpy() for name, column in columns.items()}


def _expect_same(found: GaussianCloud, expected: GaussianCloud) -> None:
    for name in ("centers", "rotations", "log_scales", "logit_opacities", "harmonics"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def _header(order: str, count: int, names: list[str], kind: str = "float", extra: str = "") -> str:
    lines = ["ply", f"format {order} 1.0", "comment by hand", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property {kind} {name}" for name in names), *extra.split(";"), "end_header", ""])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_written_is_read_to_the_last_bit(tmp_path: Path, degree: int) -> None:
    write_splats(_cloud(degree=degree), tmp_path / "cloud.ply")
    found = read_splats(tmp_path / "cloud.ply")
    assert found.degree == degree
    _expect_same(found, _cloud(degree=degree))


def test_the_file_is_laid_out_as_3dgs_lays_it_out(tmp_path: Path) -> None:
    cloud = _cloud()
    write_splats(cloud, tmp_path / "cloud.ply")
    header, _, body = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    rest = [f"f_rest_{place}" for place in range(9)]
    assert names == [*ORDER[:3], "nx", "ny", "nz", *ORDER[3:6], *rest, *ORDER[6:]]
    expected = _columns(cloud) | dict.fromkeys(("nx", "ny", "nz"), np.zeros(7, dtype=np.float32))
    for row in range(7):
        values = struct.unpack_from(f"<{len(names)}f", body, 4 * len(names) * row)
        assert dict(zip(names, values, strict=True)) == {name: expected[name][row] for name in names}
    # Any reader of .ply finds the points.
    points = trimesh.load(tmp_path / "cloud.ply").vertices
    np.testing.assert_array_equal(np.asarray(points, dtype=np.float32), cloud.centers.numpy())


@pytest.mark.parametrize("order", ["ascii", "binary_big_endian", "binary_little_endian"])
def test_any_order_of_properties_and_more_of_them_are_read(tmp_path: Path, order: str) -> None:
    cloud = _cloud()
    columns = _columns(cloud) | {"red": np.arange(7, dtype=np.float32)}
    names = sorted(columns, reverse=True)
    table = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
    if order == "ascii":
        body = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in table).encode()
    else:
        body = table.astype(">f8" if order == "binary_big_endian" else "<f8").tobytes()
    header = _header(order, 7, names, "double").replace("\n", "\r\n" if order == "ascii" else "\n")
    (tmp_path / "cloud.ply").write_bytes(header.encode() + body)
    _expect_same(read_splats(tmp_path / "cloud.ply"), cloud)


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian"])
def test_elements_before_the_vertices_are_passed_over(tmp_path: Path, order: str) -> None:
    cloud = _cloud(degree=0)
    spelt = _columns(replace(cloud, harmonics=torch.cat([cloud.harmonics, torch.zeros(7, 3, 3)], dim=1)))
    header = _header(order, 7, ORDER).replace(
        "element vertex", "element camera 2\nproperty uchar a\nproperty int b\nelement vertex"
    )
    table = np.stack([spelt[name] for name in ORDER], axis=1).astype("<f4")
    text = "1 2\n3 4\n" + " ".join(f"{value:.9g}" for value in table.ravel())
    body = text.encode() if order == "ascii" else bytes(10) + table.tobytes()
    (tmp_path / "cloud.ply").write_bytes(header.encode() + body)
    _expect_same(read_splats(tmp_path / "cloud.ply"), cloud)


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian"])
def test_a_file_that_was_cut_short_says_where(tmp_path: Path, order: str) -> None:
    row = b"0 " * 14 if order == "ascii" else bytes(4 * 14)
    (tmp_path / "cut.ply").write_bytes(_header(order, 5, ORDER).encode() + 3 * row + row[:7])
    with raises(SceneError, file="cut.ply", row=3, value=3):
        read_splats(tmp_path / "cut.ply")


@pytest.mark.parametrize(
    ("content", "name", "value"),
    [
        (b"\x89PNG\r\n\x1a\n", "header", b"\x89PNG\r\n\x1a\n"),
        (b"ply\nformat ascii 1.0\n", "header", b"ply\nformat a"),
        (b"ply\nelement vertex 1\nend_header\n", "format", None),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "header", "element vertex many"),
        (_header("ascii", 1, [*ORDER, "x"]).encode(), "header", "property float x"),
        (_header("ascii", 1, [*ORDER[:-1]]).encode(), "rot_3", ["rot_3"]),
        (_header("ascii", 1, [*ORDER, "f_rest_0"]).encode(), "f_rest", 1),
        (_header("ascii", 0, ORDER).encode(), "vertex", 0),
        (_header("ascii", 1, ORDER, extra="property list uchar int more").encode(), "list", None),
        (b"ply\nformat ascii 1.0\nelement spring 1\nproperty float k\nend_header\n1\n", "elements", ["spring"]),
        (_header("ascii", 1, ["packed_position"], "uint").encode(), "compression", ["vertex"]),
        (trimesh.creation.box().export(file_type="ply"), "face", 12),
        (trimesh.PointCloud(np.eye(3)).export(file_type="ply"), "vertex", 3),
        (_header("ascii", 1, ORDER).encode() + b"0 " * 13 + b"zero\n", "vertex", None),
    ],
)
def test_what_is_no_cloud_says_what_it_is(tmp_path: Path, content: bytes, name: str, value: Any) -> None:
    (tmp_path / "wrong.ply").write_bytes(content)
    value = {} if value is None else {"value": value}
    with raises(SceneError, file="wrong.ply", name=name, **value):
        read_splats(tmp_path / "wrong.ply")


def test_numbers_that_no_gaussian_has_and_places_that_no_file_has_are_refused(tmp_path: Path) -> None:
    for change, row, name in (("log_scales", 4, "scale_1"), ("rotations", 2, "rot_0")):
        cloud = _cloud()
        getattr(cloud, change)[row, 1 if row == 4 else slice(None)] = torch.nan if row == 4 else 0.0
        write_splats(cloud, tmp_path / "spoilt.ply")
        with raises(SceneError, file="spoilt.ply", row=row, name=name):
            read_splats(tmp_path / "spoilt.ply")
    with raises(SceneError, file="none.ply"):
        read_splats(tmp_path / "none.ply")
    with raises(SceneError, file="spoilt.ply/cloud.ply"):
        write_splats(_cloud(), tmp_path / "spoilt.ply" / "cloud.ply")


def test_gaussians_are_told_from_a_mesh_by_the_header(tmp_path: Path) -> None:
    write_splats(_cloud(), tmp_path / "cloud.ply")
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    names = ("cloud.ply", "mesh.ply", "none.ply")
    assert [holds_gaussians(tmp_path / name) for name in names] == [True, False, False]
