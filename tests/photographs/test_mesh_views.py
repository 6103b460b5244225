"""Meshes read and rendered, against closed forms and against the files' own colors."""

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from avmsf.errors import CaptureError
from avmsf.mesh import Surface
from avmsf.mesh.textured_mesh import GRAY, TexturedMesh, read_textured_mesh
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.mesh_views import FOCAL, SKY, MeshTracer, orbit_cameras, render_views
from factories.looked_at import surface_of
from factories.raising import raises

RADIUS, DISTANCE = 0.1, 0.5


def sphere(subdivisions: int = 5) -> TexturedMesh:
    return TexturedMesh.plain(surface_of(trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)))


def facing(size: int = 64, *, focal: float = 100.0, distance: float = 1.0) -> Camera:
    """A camera on the negative z axis that looks along z, with y downwards in its image."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = distance
    return Camera(pose, (focal, focal), (size / 2, size / 2), size, size)


def aimed(position: torch.Tensor, up: tuple[float, float, float], width: int, height: int, *, focal=100.0) -> Camera:
    """A camera that looks at the origin."""
    return Camera.looking(position, torch.zeros(3), up=torch.tensor(up), focal=focal, width=width, height=height)


def card(texture: np.ndarray, *, half: float = 0.32) -> TexturedMesh:
    """A square in the plane z = 0 that shows the texture upright to `facing`."""
    corners = torch.tensor([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    # y points down in the image, v up in the texture.
    places = torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])[faces]
    return TexturedMesh.build(corners, faces, coordinates=places, textures=[torch.from_numpy(texture)])


def noise(size: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)


def test_a_spheres_silhouette_has_the_area_of_its_cone() -> None:
    camera = facing(128, focal=250.0, distance=DISTANCE)
    (view,) = render_views(sphere(), [camera], supersample=4)
    # The tangent cone meets the image in a circle of radius f r / sqrt(d^2 - r^2).
    area = math.pi * 250.0**2 * RADIUS**2 / (DISTANCE**2 - RADIUS**2)
    # The faces lie inside the sphere by .03 % of its radius; the rays' grid leaves about as much again.
    assert float(view.coverage.sum()) == pytest.approx(area, rel=2e-3)


def test_depth_of_a_sphere() -> None:
    camera = facing(96, focal=200.0, distance=DISTANCE)
    depth = MeshTracer(sphere().surface).depth(camera)
    rays = camera.rays()
    along = rays[..., 2] * DISTANCE
    under = along.square() - DISTANCE**2 + RADIUS**2
    hit = depth > 0
    assert bool((hit == (under > 0)).float().mean() > 0.998)
    clear = hit & (under > 0.1 * RADIUS**2)
    reach = along - under.clamp(min=0).sqrt()
    # Facets cut at most 3e-4 of the radius off; at this slant their depth changes by three times that.
    assert float((depth - reach * rays[..., 2])[clear].abs().max()) < 1e-3 * RADIUS


@pytest.mark.parametrize("times", [1, 4])
def test_an_unlit_picture_of_a_texture_is_the_texture_which_repeats(times: int) -> None:
    texture = noise(64 // times)
    mesh = card(texture)
    places = times * mesh.coordinates - int(times > 1)
    mesh = TexturedMesh.build(mesh.vertices, mesh.faces, coordinates=places, textures=mesh.textures)
    # One pixel a texel: the ray through a pixel's center meets the texel's center.
    (view,) = render_views(mesh, [facing()], ambient=1.0, supersample=1)
    assert np.array_equal(view.image.numpy(), np.tile(texture, (times, times, 1)))
    assert bool((view.mask == 255).all())


def test_texels_finer_than_pixels_give_their_mean() -> None:
    fine = (np.indices((500, 500)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, axis=2)
    (view,) = render_views(card(fine), [facing()], ambient=1.0, supersample=1)
    # 7.8 texels a pixel: without smaller copies, rays would see black, white or what lies between by turns.
    assert float((view.image[2:-2, 2:-2].float() - 127.5).abs().max()) <= 1


def test_colors_between_corners_are_their_mean() -> None:
    vertices = torch.tensor([[-0.3, -0.3, 0.0], [0.3, -0.3, 0.0], [0.0, 0.3, 0.0]])
    mesh = TexturedMesh.build(vertices, torch.tensor([[0, 1, 2]]), colors=torch.eye(3)[None])
    camera = facing(65)
    (view,) = render_views(mesh, [camera], ambient=1.0)
    pixels, _ = camera.project(vertices.mean(0, keepdim=True))
    across, down = pixels[0].long().tolist()
    # A pixel is a 60th of the side: the colors change by 4 from one to the next.
    assert np.allclose(view.image[down, across].numpy(), 85, atol=4)


def test_a_mask_says_how_much_of_a_pixel_is_covered() -> None:
    # The card's edges lie a third and two thirds into pixels of 0.01 m.
    left, right = -0.1 - 1 / 300, 0.1 + 2 / 300
    vertices = torch.tensor([[left, -0.2, 0], [right, -0.2, 0], [right, 0.2, 0], [left, 0.2, 0]])
    mesh = TexturedMesh.build(vertices, torch.tensor([[0, 1, 2], [0, 2, 3]]), colors=torch.full((2, 3, 3), 0.2))
    (view,) = render_views(mesh, [facing()], ambient=1.0, supersample=3, background=(1.0, 0.5, 0.0))
    assert view.mask[32, 20:24].tolist() == [0, 85, 255, 255]
    assert view.mask[32, 40:44].tolist() == [255, 255, 170, 0]
    for column, part in ((20, 0.0), (21, 1 / 3), (30, 1.0), (42, 2 / 3)):
        expected = [255 * (part * 0.2 + (1 - part) * back) for back in (1.0, 0.5, 0.0)]
        assert np.allclose(view.image[32, column].numpy(), expected, atol=0.51), column


def test_faces_are_as_bright_as_the_part_of_the_sky_that_they_see() -> None:
    mesh = TexturedMesh.plain(surface_of(trimesh.creation.box((0.2, 0.2, 0.2))))
    for axis in range(3):
        for sign in (-1.0, 1.0):
            position = torch.zeros(3)
            position[axis] = sign
            camera = aimed(position, tuple(torch.eye(3)[(axis + 1) % 3].tolist()), 32, 32)
            (view,) = render_views(mesh, [camera], ambient=0.2)
            expected = 255 * GRAY * (0.2 + 0.8 * (1 + sign * SKY[axis]) / 2)
            assert np.allclose(view.image[16, 16].numpy(), expected, atol=0.51)


def test_both_sides_are_seen_in_the_light_of_their_front() -> None:
    for flip in ([0, 1, 2], [0, 2, 1]):
        mesh = TexturedMesh.build(torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]), torch.tensor([flip]))
        assert MeshTracer(mesh.surface).depth(facing(9))[4, 4].item() == pytest.approx(1.0, abs=1e-12)
        (view,) = render_views(mesh, [facing(9)], ambient=0.0)
        assert np.allclose(view.image[4, 4].numpy(), 255 * GRAY * (1 - SKY[2]) / 2, atol=0.51)


def test_a_mesh_far_from_the_origin_is_seen_as_sharply() -> None:
    near = sphere(3)
    away = torch.tensor([3000.0, -2000.0, 500.0], dtype=torch.float64)
    moved = Surface(near.vertices.double() + away, near.faces)
    camera = facing(48, focal=150.0, distance=DISTANCE)
    pose = camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ away
    (here,) = render_views(near, [camera])
    there = MeshTracer(moved).depth(Camera(pose, camera.focal, camera.principal, 48, 48))
    assert bool(((there > 0) == (here.mask > 127)).float().mean() > 0.99)


def test_orbits_are_the_72_views() -> None:
    ball = sphere(2).surface
    cameras = orbit_cameras(ball)
    assert len(cameras) == 72
    assert {(camera.width, camera.height, camera.focal) for camera in cameras} == {(1024, 1024, (FOCAL, FOCAL))}
    places = torch.stack([camera.position for camera in cameras])
    # Five units, of which the half diagonal of the bounding box has 2.25; the box is exact to float32.
    unit = math.sqrt(3) * RADIUS / 2.25
    assert places.norm(dim=1).numpy() == pytest.approx(5 * unit, rel=1e-6)
    heights = torch.rad2deg(torch.asin(places[:, 2] / places.norm(dim=1)))
    assert heights.reshape(3, 24).numpy() == pytest.approx(np.array([[0.0], [45.0], [-45.0]]).repeat(24, axis=1), abs=1e-4)  # fmt: skip  # noqa: E501
    for camera in cameras[::7]:
        pixels, _ = camera.project(torch.zeros(1, 3))
        assert pixels[0].tolist() == pytest.approx([512, 512], abs=1e-3)
    small = orbit_cameras(ball, size=256, elevations=(90 - 1e-3, 10.0), azimuths=3, up=(0.0, 1.0, 0.0))
    assert len(small) == 6
    assert small[0].focal[0] == FOCAL / 4
    assert small[0].position.tolist() == pytest.approx([0, 5 * unit, 0], abs=1e-3)


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_textured_files_look_as_what_they_were_written_from(tmp_path: Path, kind: str) -> None:
    texture = noise(64)
    mesh = card(texture)
    places = mesh.coordinates.reshape(-1, 2).numpy()
    corners = mesh.vertices[mesh.faces].reshape(-1, 3).numpy()
    image = Image.fromarray(texture)
    if kind == "obj":
        material = trimesh.visual.material.SimpleMaterial(image=image)
    else:
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    visual = trimesh.visual.TextureVisuals(uv=places, material=material)
    shape = trimesh.Trimesh(corners, np.arange(6).reshape(2, 3), visual=visual, process=False)
    (shape if kind == "obj" else trimesh.Scene([shape])).export(tmp_path / f"card.{kind}")
    read = read_textured_mesh(tmp_path / f"card.{kind}")
    assert len(read.vertices) == 4
    (view,) = render_views(read, [facing()], ambient=1.0, supersample=1)
    assert np.array_equal(view.image.numpy(), texture)


def test_parts_keep_their_own_textures(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for number, color in enumerate(((255, 0, 0), (0, 0, 255))):
        # The factor multiplies the image, as glTF says.
        image = Image.new("RGB", (4, 4), (255, 255, 255))
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image, baseColorFactor=[*color, 255])
        visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
        plain = trimesh.creation.box((0.1, 0.1, 0.1))
        box = trimesh.Trimesh(np.asarray(plain.vertices), np.asarray(plain.faces), visual=visual, process=False)
        scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([0.3 * number - 0.15, 0, 0]))
    scene.export(tmp_path / "two.glb")
    read = read_textured_mesh(tmp_path / "two.glb")
    (view,) = render_views(read, [facing()], ambient=1.0)
    assert view.image[32, 16].tolist() == [255, 0, 0]
    assert view.image[32, 48].tolist() == [0, 0, 255]


EMPTY, BLACK = torch.zeros(0, 3, dtype=torch.int64), torch.zeros(64, 64, 3, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("call", "name", "value"),
    [
        (lambda: render_views(sphere(1), []), "cameras", 0),
        (lambda: render_views(sphere(1), [facing(8)], supersample=0), "supersample", 0),
        (lambda: render_views(sphere(1), [facing(8)], background=(0.0, 0.0, 255.0)), "background", (0.0, 0.0, 255.0)),
        (lambda: MeshTracer(Surface(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))), "area", 0.0),
        (lambda: orbit_cameras(Surface(torch.zeros(2, 3), EMPTY)), "surface", 0.0),
        (lambda: TexturedMesh.plain(Surface(torch.eye(3), EMPTY)), "faces", 0),
        (lambda: TexturedMesh.build(torch.arange(9.0).reshape(3, 3), torch.tensor([[0, 1, 2]])), "area", 0.0),
        (lambda: TexturedMesh.build(torch.eye(3), torch.tensor([[0, 1, 3]])), "faces", 3),
        (lambda: replace(facing(), focal=(0.0, 50.0)), "camera", None),
        (lambda: replace(facing(), width=0), "camera", None),
        (lambda: replace(facing(), world_to_camera=torch.full((4, 4), torch.nan)), "camera", None),
        (lambda: aimed(torch.tensor([0.0, 0.0, 1.0]), (0.0, 0.0, 2.0), 8, 8), "up", [0.0, 0.0, 2.0]),
        (lambda: View("a.png", BLACK[:8, :9], facing()), "a.png", [8, 9]),
        (lambda: View("a.png", BLACK, facing(), BLACK[:8, :9, 0]), "a.png", [8, 9]),
    ],
)
def test_scenes_and_cameras_that_cannot_be_are_refused(call, name: str, value: object) -> None:
    with raises(CaptureError, name=name) as caught:
        call()
    assert value is None or caught.value.value == value


REAL = {"mug": False, "bowl": False, "blue_cup": True, "plate_holder": True}


@pytest.mark.parametrize("name", REAL)
def test_scanned_objects_fill_the_places_of_their_vertices(shared: Path, name: str) -> None:
    path = shared / "meshes" / name / "textured.obj"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mesh = read_textured_mesh(path)
    # Two come without their image.
    assert [str(warning.message).count("texture_map.png is missing") for warning in caught] == [1] * (not REAL[name])
    assert (mesh.textures[0].shape[0] > 1) == REAL[name]
    cameras = orbit_cameras(mesh.surface, size=128, azimuths=2)
    for view in render_views(mesh, cameras, supersample=2):
        pixels, depth = view.camera.project(mesh.vertices)
        assert bool((depth > 0).all())
        across, down = pixels.long().clamp(0, 127).T
        # An outermost vertex may lie in a pixel none of whose four rays meets the mesh.
        grown = torch.nn.functional.max_pool2d(view.mask[None].float(), 3, stride=1, padding=1)[0]
        assert float((grown[down, across] > 0).float().mean()) > 0.999
        rows, columns = view.mask.nonzero().T
        low, high = pixels.amin(0), pixels.amax(0)
        assert bool(((columns + 1 >= low[0]) & (columns <= high[0]) & (rows + 1 >= low[1]) & (rows <= high[1])).all())
