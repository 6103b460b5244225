"""Rings photographed before plain walls, known to the pixel; votes of views; and photographs of a dinosaur."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import distance_transform_edt, map_coordinates

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.mesh.level_set import Grid
from avmsf.photographs import find_foreground, read_views
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.visual_hull import carve, project_votes
from factories.raising import raises, warns
from factories.views_folder import ring


@pytest.mark.parametrize("linear", [False, True])
def test_votes_are_the_images_values_where_a_camera_projects_the_cells(linear: bool) -> None:
    cameras, generator = ring(3), np.random.default_rng(0)
    size = cameras[0].width, cameras[0].height
    images = [generator.random(size[::-1]) for _ in cameras]
    # Some of its cells are beyond the images and some behind the cameras, which are 2 m from its middle.
    grid = Grid(np.array([-2.513, -1.487, -1.031]), 0.2317, (22, 14, 9))
    cells = np.sort(generator.choice(22 * 14 * 9, 1500, replace=False))
    votes = np.zeros((2, 3, len(cells)))

    def keep(part: slice, view: int, values: np.ndarray, depths: np.ndarray) -> None:
        votes[:, view, part] = values, depths

    project_votes(grid, cells, cameras, images, keep, linear=linear)
    centers = grid.centers(np.stack(np.unravel_index(cells, grid.shape), axis=1))
    for camera, image, values, depths in zip(cameras, images, *votes, strict=True):
        pixels, depth = (each.numpy() for each in camera.project(torch.from_numpy(centers)))
        assert depths == pytest.approx(depth)
        seen = ((pixels >= 0) & (pixels < size)).all(axis=1)
        assert np.array_equal(np.isnan(values), ~seen)
        assert 100 < seen.sum() < len(cells) - 100
        assert (depth < 0).any()
        rows, columns = pixels[seen, 1], pixels[seen, 0]
        if linear:
            expected = map_coordinates(image, [rows - 0.5, columns - 0.5], order=1, mode="nearest")
        else:
            expected = image[rows.astype(int), columns.astype(int)]
        # At the last row and column weights are a thousandth short.
        assert values[seen] == pytest.approx(expected, abs=2e-3)


WIDTH, HEIGHT = 120, 90
RING, TUBE = 0.1, 0.03


@cache
def ring_mesh() -> trimesh.Trimesh:
    return trimesh.creation.torus(RING, TUBE, major_sections=64, minor_sections=24)


@cache
def cameras(count: int = 18) -> tuple[Camera, ...]:
    """Around and above and below a ring that lies in the plane z = 0; every third lets it leave the image."""
    found = []
    for row in range(count):
        angle, height = 2.4 * row, np.sin(1.7 * row)
        level = np.sqrt(1 - 0.8 * height**2)
        position = 0.6 * torch.tensor([level * np.cos(angle), level * np.sin(angle), 0.9 * height])
        target = torch.tensor([0.0, 0.0, 0.05 if row % 3 == 0 else 0.0])
        up = torch.tensor([0.0, 0.0, 1.0])
        found.append(Camera.looking(position, target, up=up, focal=180.0, width=WIDTH, height=HEIGHT))
    return tuple(found)


@cache
def seen(row: int) -> tuple[np.ndarray, np.ndarray]:
    """Where camera `row` sees the ring, and how bright a lamp above the camera lights it, 0 to 1."""
    camera = cameras()[row]
    rays = camera.rays().numpy().reshape(-1, 3)
    origins = np.broadcast_to(camera.position.numpy(), rays.shape)
    faces = ring_mesh().ray.intersects_first(origins, rays)
    lamp = -rays.mean(axis=0) + np.array([0, 0, 0.5])
    light = np.abs(ring_mesh().face_normals[faces] @ lamp) / np.linalg.norm(lamp)
    return (faces >= 0).reshape(HEIGHT, WIDTH), light.reshape(HEIGHT, WIDTH)


def photographs(
    wall: tuple[float, float, float], paint: tuple[float, float, float], *, falloff: float = 0.0
) -> list[View]:
    """The ring in a color before a wall whose corners are darker by a share `falloff`."""
    generator = np.random.default_rng(0)
    across, down = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
    lit = 1 - falloff * (across**2 + down**2) / 2
    views = []
    for row, camera in enumerate(cameras()):
        there, light = seen(row)
        ring = np.array(paint) * (0.35 + 0.65 * light[..., None])
        image = np.where(there[..., None], ring, np.array(wall) * lit[..., None])
        image += 1.5 * generator.standard_normal(image.shape)
        views.append(View(f"{row:02}.png", torch.from_numpy(image.round().clip(0, 255).astype(np.uint8)), camera))
    return views


@pytest.fixture
def views() -> list[View]:
    return photographs((2.0, 2.0, 2.0), (220.0, 215.0, 205.0))


def painted(view: View, where: np.ndarray, color: Sequence[float]) -> View:
    image = view.image.numpy().copy()
    image[where] = color
    return replace(view, image=torch.from_numpy(image))


def overlap(view: View, row: int) -> float:
    """Intersection over union of the mask and the truth."""
    found, true = view.mask.numpy() > 127, seen(row)[0]
    return float((found & true).sum() / (found | true).sum())


WALLS = {
    "white on black": ((2.0, 2.0, 2.0), (220.0, 215.0, 205.0), 0.0),
    "brown on white": ((235.0, 235.0, 230.0), (120.0, 80.0, 50.0), 0.25),
    "red on green": ((60.0, 150.0, 70.0), (190.0, 60.0, 50.0), 0.2),
}


@pytest.mark.parametrize(
    "name", [name if name == "brown on white" else pytest.param(name, marks=pytest.mark.slow) for name in WALLS]
)
def test_outlines_and_the_hole_are_found(name: str) -> None:
    wall, paint, falloff = WALLS[name]
    views = find_foreground(photographs(wall, paint, falloff=falloff))
    assert len(views) == len(cameras())
    # The outline of a ring some 50 pixels wide and 13 thick has 200 pixels of 1000; a blur takes half of one.
    assert min(overlap(view, row) for row, view in enumerate(views)) > 0.9
    # Seen from above, the middle of the ring is wall.
    steep = [row for row, camera in enumerate(cameras()) if abs(float(camera.position[2])) > 0.35]
    assert len(steep) > 3
    for row in steep:
        column, line = cameras()[row].project(torch.zeros(1, 3))[0][0].int().tolist()
        assert not views[row].mask[line, column]


def test_a_shadow_as_dark_as_the_wall_is_filled_and_spots_are_dropped(views: list[View]) -> None:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    shadows = {}
    for row in (1, 7, 12):
        there = seen(row)[0]
        # The pixel of the ring that lies deepest inside it, and all within three pixels of it.
        y, x = np.unravel_index(distance_transform_edt(there).argmax(), there.shape)
        shadows[row] = np.hypot(rows - y, columns - x) <= 3
        assert there[shadows[row]].all()
        views[row] = painted(views[row], shadows[row], (2.0, 2.0, 2.0))
    spot = np.zeros((HEIGHT, WIDTH), dtype=bool)
    spot[2:14, 2:14] = True
    assert not seen(4)[0][spot].any()
    views[4] = painted(views[4], spot, (200.0, 200.0, 200.0))
    found = find_foreground(views)
    for row, shadow in shadows.items():
        assert (found[row].mask.numpy()[shadow] == 255).all()
    assert not found[4].mask.numpy()[spot].any()
    assert min(overlap(view, row) for row, view in enumerate(found)) > 0.9


def test_given_masks_stay(views: list[View]) -> None:
    given = torch.from_numpy(seen(5)[0].astype(np.uint8) * np.uint8(200))
    views[5] = replace(views[5], mask=given)
    found = find_foreground(views)
    assert found[5].mask is given
    assert all(view.mask is not None for view in found)
    assert find_foreground(found) == found


def test_views_without_object_are_named_and_left_out(views: list[View]) -> None:
    views[3] = painted(views[3], np.ones((HEIGHT, WIDTH), dtype=bool), (2.0, 2.0, 2.0))
    with warns(CaptureWarning, name="object", value=["03.png"]):
        assert len(find_foreground(views)) == len(views) - 1


def shelves(view: View, row: int) -> View:
    shelf = np.kron(np.random.default_rng(row).integers(0, 256, (9, 12, 3)), np.ones((10, 10, 1)))
    there = ~seen(row)[0]
    return painted(view, there, shelf[there])


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda views: views[:2], "views"),
        (lambda views: [painted(view, np.ones((HEIGHT, WIDTH), dtype=bool), (9, 9, 9)) for view in views], "object"),
        (lambda views: [shelves(view, row) for row, view in enumerate(views)], "background"),
    ],
    ids=["few", "blank", "busy"],
)
def test_few_blank_and_busy_photographs_are_refused(views: list[View], change, name: str) -> None:
    with raises(CaptureError, name=name):
        find_foreground(change(views))


def test_cameras_that_do_not_fit_are_warned_of_and_colors_decide_alone(views: list[View]) -> None:
    turned = []
    for row, view in enumerate(views):
        pose = view.camera.world_to_camera.clone()
        pose[:3, 3] += torch.tensor([0.4 * (-1) ** row, 0.3 * (-1) ** (row // 2), 0.1 * row])
        turned.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    with warns(CaptureWarning, name="masks"):
        found = find_foreground(turned)
    assert min(overlap(view, row) for row, view in enumerate(found)) > 0.9


LOW, HIGH = (-0.0419, 0.0011, -0.0378), (0.0309, 0.0882, 0.0355)


@pytest.fixture(scope="module")
def dino(shared: Path) -> tuple[View, ...]:
    return read_views(shared / "dino", longest=320)


def box_in(view: View) -> np.ndarray:
    """Where the bounding box lies in a view's image."""
    corners = torch.cartesian_prod(*torch.tensor([LOW, HIGH]).T.double())
    pixels = view.camera.project(corners)[0].numpy()
    outline = cv2.convexHull(np.round(pixels - 0.5).astype(np.int32))
    filled = np.zeros((view.camera.height, view.camera.width), dtype=np.uint8)
    cv2.fillConvexPoly(filled, outline, 1)
    return filled > 0


def test_views_from_one_place_are_warned_of(views: list[View]) -> None:
    # Lines of sight that meet in the camera to the last bit.
    camera = replace(views[0].camera, world_to_camera=torch.eye(4, dtype=torch.float64))
    with warns(CaptureWarning, name="masks"):
        find_foreground([replace(view, camera=camera) for view in views])


def test_what_is_bright_in_all_views_fills_the_bounding_box(dino: tuple[View, ...]) -> None:
    """The shape that the photographs agree on ends where the box does: no axis is turned, no length is scaled."""
    assert [view.name for view in dino] == sorted(view.name for view in dino)
    assert (len(dino), dino[0].camera.focal) == (73, (3310.4 / 2, 3325.5 / 2))
    # A pixel's blur at the box's faces, which touch the object.
    assert min(box_in(view)[view.image.numpy().max(axis=2) > 100].mean() for view in dino) > 0.995
    masks = [view.image.numpy().max(axis=2) > 40 for view in dino]
    hull = carve(masks, [view.camera for view in dino])
    inside = hull.grid.centers(np.argwhere(hull.occupied(missing=2)))
    # Millimetres: shadows cost some, a cube is 1 mm, and a pixel 0.4 mm.
    assert np.abs(inside.min(axis=0) - LOW).max() < 4e-3
    assert np.abs(inside.max(axis=0) - HIGH).max() < 4e-3


@pytest.mark.slow
def test_the_foreground_is_the_dinosaur(dino: tuple[View, ...]) -> None:
    views = find_foreground(dino[::2])
    assert [view.name for view in views] == [view.name for view in dino[::2]]
    shares, dark = [], []
    for view in views:
        mask, level = view.mask.numpy() > 127, view.image.numpy().max(axis=2)
        # Whatever is as bright as the ceramic's lit half is ceramic.
        assert mask[level > 90].mean() > 0.995, view.name
        # Next to nothing lies outside the bounding box: blur, and folds of cloth right behind its faces.
        assert (mask & ~cv2.dilate(box_in(view).astype(np.uint8), np.ones((7, 7))).astype(bool)).sum() < 40, view.name
        count, _, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        assert statistics[1:, cv2.CC_STAT_AREA].max() > 0.97 * mask.sum(), view.name
        shares.append(mask.mean())
        dark.append(mask[level < 20].sum() / mask.sum())
        assert count >= 2
    assert min(shares) > 0.15
    assert max(shares) < 0.55
    # Shadows are filled: some views have many dark pixels inside. The black between limbs is not: no view has a tenth.
    assert max(dark) > 0.01
    assert max(dark) < 0.1
