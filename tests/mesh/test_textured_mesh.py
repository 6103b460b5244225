"""Colors, textures and normals of meshes, as their files have them."""

import io
import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from avmsf.errors import CaptureWarning
from avmsf.mesh.textured_mesh import GRAY, TexturedMesh, read_textured_mesh
from factories.looked_at import surface_of
from factories.raising import warns


def box(side: float, **settings: object) -> trimesh.Trimesh:
    plain = trimesh.creation.box((side, side, side))
    return trimesh.Trimesh(np.asarray(plain.vertices), np.asarray(plain.faces), process=False, **settings)


def test_smooth_where_it_is_round_and_sharp_at_edges() -> None:
    ball = TexturedMesh.plain(surface_of(trimesh.creation.icosphere(subdivisions=3, radius=0.1)))
    assert float((ball.normals - ball.vertices[ball.faces] / 0.1).norm(dim=-1).max()) < 0.01
    mesh = TexturedMesh.plain(surface_of(trimesh.creation.cylinder(radius=1.0, height=2.0, sections=48)))
    corners = mesh.vertices[mesh.faces]
    lid = (corners[..., 2].amax(1) - corners[..., 2].amin(1)) < 1e-6
    assert bool((mesh.normals[lid][..., 2].abs() > 1 - 1e-6).all())
    # At the rim a side face keeps its own normal, half a section (3.75 degrees) off the corner's direction.
    outward = corners[~lid][..., :2] / corners[~lid][..., :2].norm(dim=-1, keepdim=True)
    assert float((mesh.normals[~lid][..., :2] * outward).sum(-1).min()) > math.cos(math.radians(3.76))


def test_vertex_and_face_colors_are_read(tmp_path: Path) -> None:
    box(0.2, vertex_colors=np.tile([10, 200, 30, 255], (8, 1))).export(tmp_path / "vertices.ply")
    assert np.allclose(read_textured_mesh(tmp_path / "vertices.ply").colors[..., 1], 200 / 255)
    own = np.arange(12)[:, None] * [20, 1, 0, 0] + [0, 0, 7, 255]
    box(0.2, face_colors=own).export(tmp_path / "faces.ply")
    read = read_textured_mesh(tmp_path / "faces.ply", meters=0.01)
    assert np.allclose(read.colors[..., 0] * 255, 20 * np.arange(12)[:, None].repeat(3, axis=1), atol=1e-3)
    assert float(read.vertices.max()) == pytest.approx(1e-3)


@pytest.mark.parametrize("kind", ["stl", "ply", "obj"])
def test_without_colors_a_mesh_is_gray_and_says_so(tmp_path: Path, kind: str) -> None:
    box(0.2).export(tmp_path / f"box.{kind}")
    with warns(CaptureWarning, file=f"box.{kind}", name="colors"):
        read = read_textured_mesh(tmp_path / f"box.{kind}")
    assert bool((read.colors == GRAY).all())
    assert (len(read.vertices), len(read.faces)) == (8, 12)


def cut_short(size: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)).save(file, "png")
    return file.getvalue()[:size]


@pytest.mark.parametrize(
    ("image", "library", "value", "color"),
    [
        (None, "map_Kd skin.png", "skin.png", [255 * GRAY] * 3),
        (cut_short(3000), "map_Kd skin.png", None, [255 * GRAY] * 3),
        (None, "", "no warning", [127, 63, 255]),
    ],
    ids=["missing", "corrupt", "no image"],
)
def test_a_texture_that_cannot_be_read_is_named_and_a_material_without_one_has_its_color(
    tmp_path: Path, image: bytes | None, library: str, value: str | None, color: list[float]
) -> None:
    (tmp_path / "card.obj").write_text(
        "mtllib card.mtl\nusemtl skin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    )
    (tmp_path / "card.mtl").write_text(f"newmtl skin\nKd 0.5 0.25 1\n{library}\n")
    if image is not None:
        (tmp_path / "skin.png").write_bytes(image)
    warned = warns(CaptureWarning, file="card.obj", name="texture", value=value) if library else nullcontext()
    with warned:
        read = read_textured_mesh(tmp_path / "card.obj")
    assert np.allclose(read.colors.numpy() * 255, color, atol=1)
