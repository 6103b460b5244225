"""Colors, textures and normals of meshes, and the surface around what a grid's values enclose."""

import io
import math
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from avmsf.errors import CaptureWarning, SceneError
from avmsf.mesh.level_set import Grid, decimated, enclose
from avmsf.mesh.surface import Surface
from avmsf.mesh.textured_mesh import GRAY, TexturedMesh, read_textured_mesh
from factories.looked_at import mesh_of, surface_of
from factories.raising import raises, warns


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
    tmp_path, image, library, value, color
):
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


RADIUS, SPACING, CELLS = 0.05, 0.0025, 52
MIDDLE = np.array([0.3, -0.2, 0.1])
LOWEST = MIDDLE - 0.5 * (CELLS - 1) * SPACING


def places() -> np.ndarray:
    """Return where the grid's values lie, meters."""
    rows = np.stack(np.meshgrid(*[np.arange(CELLS)] * 3, indexing="ij"), axis=-1)
    return LOWEST + SPACING * rows


def ball(faces: int | None = None) -> Surface:
    """Return the surface of a ball that fades from one to zero across its skin."""
    depth = RADIUS - np.linalg.norm(places() - MIDDLE, axis=-1)
    values = np.clip(0.5 + 0.5 * depth / (2 * SPACING), 0, 1).astype(np.float32)
    return enclose(values - 0.5, Grid(LOWEST, SPACING, values.shape), faces)


def off(surface: Surface) -> np.ndarray:
    """Return how far the vertices lie off the ball, meters."""
    return np.abs(np.linalg.norm(surface.vertices.numpy() - MIDDLE, axis=1) - RADIUS)


def test_a_ball_comes_back_closed_and_right_side_out() -> None:
    surface = ball()
    mesh = mesh_of(surface)
    assert mesh.is_watertight
    assert mesh.euler_number == 2
    # Between two values the ramp is nearly straight: a twentieth of a cell.
    assert off(surface).max() < 0.05 * SPACING
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)


def test_fewer_triangles_are_still_the_ball() -> None:
    surface = ball(faces=1500)
    assert len(surface.faces) <= 1500
    assert mesh_of(surface).is_watertight
    # The sagitta of triangles 5 mm wide is .1 mm.
    assert np.quantile(off(surface), 0.95) < 3e-4


def test_specks_beside_the_body_are_left_out() -> None:
    values = np.zeros((40, 20, 20), dtype=np.float32)
    values[5:15, 5:15, 5:15] = 1.0
    values[30, 10, 10] = 1.0
    surface = enclose(values - 0.5, Grid(np.array([1.0, 2.0, 3.0]), 0.1, values.shape))
    # Half a cell around the solid ones.
    assert surface.vertices.amin(0).tolist() == pytest.approx([1.45, 2.45, 3.45])
    assert surface.vertices.amax(0).tolist() == pytest.approx([2.45, 3.45, 4.45])


def test_what_encloses_nothing_or_reaches_the_edge_is_refused() -> None:
    empty, full = np.zeros((8, 8, 8), dtype=np.float32), np.ones((8, 8, 8), dtype=np.float32)
    for values in (empty, full):
        with raises(SceneError, name="values", value=[values.min() - 0.5, values.max() - 0.5]):
            enclose(values - 0.5, Grid(np.zeros(3), 0.1, values.shape))


@pytest.mark.parametrize("library", [None, "newmtl skin\nKd 1 1 1\nmap_Kd -s 1 1 1 skin.png\n"])
def test_a_texture_that_trimesh_does_not_find_is_warned_of(tmp_path: Path, library: str | None) -> None:
    Image.new("RGB", (4, 4), "red").save(tmp_path / "skin.png")
    shape = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    (tmp_path / "card.obj").write_text(f"mtllib card.mtl\nusemtl skin\n{shape}")
    if library:
        (tmp_path / "card.mtl").write_text(library)
    with warns(CaptureWarning, file="card.obj", name="texture" if library else "colors"):
        assert bool((read_textured_mesh(tmp_path / "card.obj").corner_colors == GRAY).all())


def test_meshes_that_threads_thin_at_a_time_are_those_of_one_thread():
    spheres = [trimesh.creation.icosphere(4, radius) for radius in (1.0, 2.0)]
    alone = [decimated(each.vertices, each.faces, 300)[0] for each in spheres]
    interval = sys.getswitchinterval()
    try:
        # As often as on a machine that is busy for hours.
        sys.setswitchinterval(1e-6)
        with ThreadPoolExecutor(2) as pool:
            found = list(pool.map(lambda each: decimated(each.vertices, each.faces, 300)[0], 20 * spheres))
    finally:
        sys.setswitchinterval(interval)
    assert all(np.array_equal(one, other) for one, other in zip(found, 20 * alone, strict=True))


def test_corners_have_the_texels_of_their_faces_own_corners_of_the_texture() -> None:
    texture = torch.randint(0, 256, (2, 2, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    corners, faces = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
    mesh = TexturedMesh.build(corners, faces, coordinates=corners[faces][..., :2], textures=[texture])
    # Rows of an image count downwards.
    assert torch.equal(mesh.corner_colors, (texture[[1, 1, 0, 0], [0, 1, 1, 0]] / 255.0)[faces])
    # A face that is one point of the texture.
    mesh = TexturedMesh.build(corners, faces, coordinates=torch.zeros(2, 3, 2), textures=[texture])
    assert torch.equal(mesh.corner_colors, (texture[1, 0] / 255.0).expand(2, 3, 3))
