"""What `load_mesh` returns has indices that exist and finite coordinates; what is beyond its bounds is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from avmsf._utils.text import MAX_TEXT_BYTES
from avmsf.errors import CaptureError
from avmsf.mesh import Surface
from avmsf.mesh.io import MAX_GLTF_BYTES, glb_bytes
from avmsf.mesh.textured_mesh import read_textured_mesh
from factories.raising import raises

PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n{x} 0 0\n1 0 0\n0 1 0\n3 0 1 {row}\n"
)


def glb(record: dict, binary: bytes = bytes(36)) -> bytes:
    return glb_bytes({"asset": {"version": "2.0"}, "scene": 0, **record}, binary)


def triangle(*, nodes: int = 1, count: int = 3, matrix: list[float] | None = None) -> bytes:
    corners = np.eye(3, dtype="<f4").tobytes()
    node = {"mesh": 0} if matrix is None else {"mesh": 0, "matrix": matrix}
    accessor = {"componentType": 5126, "count": count, "type": "VEC3"}
    record = {"scenes": [{"nodes": list(range(nodes))}], "nodes": [node] * nodes}
    record |= {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}]}
    record |= {"accessors": [accessor if count > 3 else accessor | {"bufferView": 0}]}
    record |= {"bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36}]}
    return glb(record, corners)


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "stl", "off"])
def test_every_format_gives_the_same_triangles(tmp_path: Path, suffix: str) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.25)
    ball.export(tmp_path / f"ball.{suffix}")
    surface = Surface.read(tmp_path / f"ball.{suffix}")
    corners = surface.vertices[surface.faces]
    assert surface.faces.shape == (len(ball.faces), 3)
    torch.testing.assert_close(corners, torch.tensor(np.array(ball.triangles)).float(), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("name", "content", "counted", "found"),
    [
        ("nodes.glb", triangle(nodes=2000), "nodes", 2000),
        ("empty.glb", triangle(count=100_000_000), "values", 100_000_000),
    ],
)
def test_counts_in_the_file_are_bounded_before_anything_is_built(tmp_path, monkeypatch, name, content, counted, found):
    def build(*_: object, **__: object) -> None:
        raise AssertionError("built before its counts were looked at")

    (tmp_path / name).write_bytes(content)
    monkeypatch.setattr(trimesh, "load", build)
    monkeypatch.setattr(trimesh, "load_scene", build)
    with raises(CaptureError, file=name, name=counted, value=found):
        Surface.read(tmp_path / name)


def test_buffers_within_a_text_gltf_may_be_larger_than_other_json(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.25)
    (content,) = trimesh.exchange.gltf.export_gltf(ball, embed_buffers=True).values()
    (tmp_path / "ball.gltf").write_bytes(content + b" " * MAX_TEXT_BYTES)
    assert len(Surface.read(tmp_path / "ball.gltf").faces) == len(ball.faces)
    with open(tmp_path / "ball.gltf", "ab") as file:
        file.truncate(MAX_GLTF_BYTES + 1)
    with raises(CaptureError, file="ball.gltf", name="bytes", value=MAX_GLTF_BYTES + 1):
        Surface.read(tmp_path / "ball.gltf")


@pytest.mark.parametrize(
    ("old", "new"),
    [("v ", "v\t"), ("f ", "f\t"), ("v ", "  v "), ("v ", "\ufeffv "), (" 3\n", " 3 # -x -y\n")],
    ids=["tab after v", "tab after f", "indented", "byte-order mark", "comment"],
)
def test_white_space_of_an_obj_changes_nothing(tmp_path: Path, old: str, new: str) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    (tmp_path / "a.obj").write_text(text.replace(old, new, 1 if new[0] == "\ufeff" else -1), encoding="utf-8")
    surface = Surface.read(tmp_path / "a.obj")
    assert surface.faces.tolist() == [[0, 1, 2], [0, 1, 3]]
    assert surface.vertices[:2].tolist() == [[0, 0, 0], [1, 0, 0]]


def test_negative_indices_count_back_from_where_they_stand(tmp_path: Path) -> None:
    blocks = [f"v {row} 0 0\nv {row} 1 0\nv {row} 0 1\nvt 0 0\nf -3/-1 -2/-1 -1/-1\n" for row in range(3)]
    (tmp_path / "a.obj").write_text("".join(blocks))
    surface = Surface.read(tmp_path / "a.obj")
    assert surface.vertices[surface.faces][:, :, 0].tolist() == [[row] * 3 for row in range(3)]


def test_normalized_integers_are_from_minus_one_to_one(tmp_path: Path) -> None:
    record = {
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "scale": [0.5, 0.5, 0.5]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]}],
        "accessors": [{"componentType": 5122, "normalized": True, "count": 3, "type": "VEC3", "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 24, "byteStride": 8}],
        "buffers": [{"byteLength": 24}],
        "extensionsRequired": ["KHR_mesh_quantization"],
    }
    corners = np.array([[32767, 0, 0, 7], [0, -32768, 0, 7], [0, 0, 16384, 7]], dtype="<i2")
    (tmp_path / "a.glb").write_bytes(glb(record, corners.tobytes()))
    vertices = Surface.read(tmp_path / "a.glb").vertices
    torch.testing.assert_close(vertices, 0.5 * torch.diag(torch.tensor([1.0, -1.0, 0.5])), atol=1e-4, rtol=0)


def ply(x: object = 0, row: object = 2) -> bytes:
    return PLY.format(x=x, row=row).encode()


AWAY = [1e30, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
CLOUD = trimesh.PointCloud(np.eye(3)).export(file_type="ply")


@pytest.mark.parametrize(
    ("name", "content", "attributes"),
    [
        *(("a.ply", ply(row=row), {"name": "faces", "value": row}) for row in (3, 99, -1)),
        *(("a.ply", ply(x=x), {"name": "vertices"}) for x in ("nan", "inf")),
        ("a.ply", ply(x="1e200"), {"name": "coordinates"}),
        ("a.ply", b"ply\nnonsense", {}),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", {}),
        ("a.obj", b"v 0 0\nv 1 0\nv 0 1\n", {"name": "vertices", "value": [3, 2]}),
        ("a.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", {"row": 1, "name": "vertices"}),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 -5\n", {"value": -5}),
        ("a.obj", b"v 0,5 0,1 0,2\nv 1,5 0,1 0,2\nv 0,5 1,1 0,2\nf 1 2 3\n", {}),
        ("a.glb", triangle(matrix=AWAY), {"name": "coordinates", "value": pytest.approx(1e30)}),
        ("a.glb", glb({"extensionsRequired": ["KHR_draco_mesh_compression"]}), {}),
        ("a.glb", bytes(range(200)), {}),
        ("a.zip", b"PK\x03\x04", {"name": "suffix", "value": ".zip"}),
        ("none.obj", None, {"name": None}),
    ],
)
@pytest.mark.parametrize("read", [Surface.read, read_textured_mesh])
def test_what_is_no_mesh_is_refused(tmp_path: Path, read, name: str, content: bytes | None, attributes: dict) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with raises(CaptureError, file=name, **attributes):
        read(tmp_path / name)


def test_points_alone_are_a_surface_and_no_mesh_with_colors(tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(CLOUD)
    assert Surface.read(tmp_path / "cloud.ply").vertices.shape == (3, 3)
    with raises(CaptureError, file="cloud.ply", name="faces", value=0):
        read_textured_mesh(tmp_path / "cloud.ply")


def test_parts_of_a_scene_stay_where_they_lie(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for place in (0.0, 2.0):
        scene.add_geometry(trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([place, 0, 0]))
    scene.export(tmp_path / "two.glb")
    surface = Surface.read(tmp_path / "two.glb", meters=0.1)
    assert surface.faces.shape == (24, 3)
    assert surface.faces.max() == len(surface.vertices) - 1
    assert [surface.vertices[:, 0].min(), surface.vertices[:, 0].max()] == pytest.approx([-0.05, 0.25], rel=1e-6)


@pytest.mark.parametrize("material", [{}, {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}}])
def test_16_bit_colors_beside_a_material_are_read(tmp_path: Path, material: dict) -> None:
    body = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + np.full((3, 4), 32768, "<u2").tobytes()
    views = [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}]
    places = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
    colors = {"bufferView": 1, "componentType": 5123, "normalized": True, "count": 3, "type": "VEC4"}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "material": 0}
    scene = {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}]}
    parts = {"accessors": [places, colors], "bufferViews": views, "buffers": [{"byteLength": 60}]}
    (tmp_path / "a.glb").write_bytes(glb({**scene, **parts, "materials": [material]}, body))
    assert np.allclose(read_textured_mesh(tmp_path / "a.glb").corner_colors, 0.5, atol=0.01)
