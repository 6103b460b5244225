"""COLMAP's models say the same as transforms.json, and distorted photographs are made straight."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.errors import CaptureError
from avmsf.photographs import read_sparse_points, read_views
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.colmap import MODELS, read_colmap, read_lenses
from avmsf.photographs.lenses import Lens, Location, undistort
from factories.raising import raises
from factories.views_folder import (
    frames,
    quaternion,
    ring,
    write_colmap_binary,
    write_colmap_text,
    write_image,
    write_transforms,
)

WRITERS = [write_colmap_text, write_colmap_binary]
NAMES = ["a.png", "b.png", "c.png", "d.png"]


def write_images(folder: Path, names: list[str] = NAMES) -> None:
    for name in names:
        write_image(folder / "images" / name)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
@pytest.mark.parametrize("write", WRITERS)
def test_models_say_the_same_as_transforms(tmp_path: Path, write: Callable[..., None], place: str) -> None:
    names = ["A/upper ring/a 1.png", *NAMES[1:]]
    write_images(tmp_path / "one", names)
    write(tmp_path / "one" / place, ring(4), names)
    rows = frames(ring(4))
    rows[0]["file_path"] = f"images/{names[0]}"
    write_transforms(tmp_path / "other", rows)
    for one, other in zip(read_views(tmp_path / "one"), read_views(tmp_path / "other"), strict=True):
        # A quaternion's rounding in float64.
        assert (one.camera.world_to_camera - other.camera.world_to_camera).abs().max() < 1e-14
        assert (one.name, one.camera.focal) == (other.name, other.camera.focal)
        assert one.camera.principal == other.camera.principal
        assert torch.equal(one.image, other.image)


@pytest.mark.parametrize("write", WRITERS)
def test_points_and_colors(tmp_path: Path, write: Callable[..., None]) -> None:
    write(tmp_path / "sparse/0", ring(4), NAMES)
    found = read_sparse_points(tmp_path, meters=2.0)
    points, colors = found
    assert torch.equal(points, torch.tensor([[1.0, -0.5, 4.0], [2.0, 4.0, 6.0]], dtype=torch.float64))
    assert colors.tolist() == [[255, 128, 0], [1, 2, 3]]
    for name in ("points3D.txt", "points3D.bin"):
        (tmp_path / "sparse/0" / name).unlink(missing_ok=True)
    assert read_sparse_points(tmp_path) is None


# By COLMAP's documentation: focal lengths, principal point, then coefficients in the order k1 k2 p1 p2.
LAYOUTS = {
    "SIMPLE_PINHOLE": ((50.0, 19.0, 16.0), (50.0, 50.0), (0, 0, 0, 0, 0)),
    "PINHOLE": ((50.0, 52.0, 19.0, 16.0), (50.0, 52.0), (0, 0, 0, 0, 0)),
    "SIMPLE_RADIAL": ((50.0, 19.0, 16.0, 0.1), (50.0, 50.0), (0.1, 0, 0, 0, 0)),
    "RADIAL": ((50.0, 19.0, 16.0, 0.1, 0.2), (50.0, 50.0), (0.1, 0.2, 0, 0, 0)),
    "OPENCV": ((50.0, 52.0, 19.0, 16.0, 0.1, 0.2, 0.3, 0.4), (50.0, 52.0), (0.1, 0.2, 0.3, 0.4, 0)),
    "OPENCV_FISHEYE": ((50.0, 52.0, 19.0, 16.0, 0.1, 0.2, 0.3, 0.4), (50.0, 52.0), (0.1, 0.2, 0.3, 0.4)),
    "SIMPLE_RADIAL_FISHEYE": ((50.0, 19.0, 16.0, 0.1), (50.0, 50.0), (0.1, 0, 0, 0)),
    "RADIAL_FISHEYE": ((50.0, 19.0, 16.0, 0.1, 0.2), (50.0, 50.0), (0.1, 0.2, 0, 0)),
}


@pytest.mark.parametrize("name", MODELS)
def test_camera_models(tmp_path: Path, name: str) -> None:
    parameters, focal, distortion = LAYOUTS[name]
    write_colmap_text(tmp_path, ring(3), NAMES[:3], (name, parameters))
    lens = read_colmap(tmp_path, tmp_path).photographs[0].lens_of(1, 1)
    assert (lens.width, lens.height, lens.principal) == (40, 30, (19.0, 16.0))
    assert lens.focal == focal
    assert lens.distortion == pytest.approx(distortion)
    assert lens.fisheye == ("FISHEYE" in name)


def test_unknown_models_and_what_is_no_file_are_named(tmp_path: Path) -> None:
    write_colmap_binary(tmp_path, ring(3), NAMES[:3])
    content = bytearray((tmp_path / "cameras.bin").read_bytes())
    for number, value in ((7, "FOV"), (99, 99)):
        content[12] = number
        (tmp_path / "cameras.bin").write_bytes(bytes(content))
        with raises(CaptureError, file="cameras.bin", name="camera 7", value=value):
            read_views(tmp_path)
    for name in ("folder.bin", "folder.txt"):
        (tmp_path / name).mkdir()
        with raises(CaptureError, file=name, value="Is a directory"):
            read_lenses(tmp_path / name)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_truncated_binary_files_are_named_wherever_they_end(tmp_path: Path, file: str) -> None:
    write_images(tmp_path)
    write_colmap_binary(tmp_path, ring(4), NAMES)
    content = (tmp_path / file).read_bytes()
    read = partial(read_sparse_points if file == "points3D.bin" else read_views, tmp_path)
    for kept in [*range(0, len(content), 7), len(content) - 1]:
        (tmp_path / file).write_bytes(content[:kept])
        with raises(CaptureError, file=file, value=kept):
            read()


POSE = " ".join(map(repr, (*quaternion(ring(4)[0]), *ring(4)[0].world_to_camera[:3, 3].tolist())))


@pytest.mark.parametrize(
    ("file", "before", "after", "row", "name"),
    [
        ("cameras.txt", " 40 ", " wide ", 2, None),
        ("cameras.txt", " 16.0", "", None, "camera 7"),
        ("images.txt", " 7 b.png", " 8 b.png", None, "b.png"),
        ("images.txt", " 7 b.png", "", 4, None),
        ("images.txt", " 7 b.png", " b.png", 4, None),
        ("images.txt", " 7 b.png", " 7 b\0.png", 4, None),
        ("cameras.txt", " 40 ", f" 1{400 * '0'} ", None, "intrinsics"),
        ("images.txt", "1.5 2.5 -1 10.0 11.0 3\n", "", 3, None),
        ("points3D.txt", " 255 ", " 256 ", 2, None),
        ("points3D.txt", " -0.25 ", " inf ", 0, None),
        ("cameras.txt", "7 PINHOLE", "7 FOV", None, "camera 7"),
        *(
            ("images.txt", POSE, pose, None, "a.png")
            for pose in ("0 0 0 0 0 0 1", "nan 0 0 1 0 0 1", "1 0 0 0 0 inf 1")
        ),
    ],
)
def test_malformed_text_is_named_by_line(tmp_path, file, before, after, row, name):
    read = read_sparse_points if file == "points3D.txt" else read_views
    write_colmap_text(tmp_path, ring(4), NAMES)
    text = (tmp_path / file).read_text()
    assert before in text
    (tmp_path / file).write_text(text.replace(before, after, 1))
    with raises(CaptureError, file=file, row=row, name=name):
        read(tmp_path)


WIDTH, HEIGHT, FOCAL, CENTER = 64, 48, (54.0, 56.0), (33.5, 22.0)
Project = Callable[[np.ndarray], np.ndarray]


def perspective(k1: float, k2: float, p1: float, p2: float) -> Project:
    """Brown's model with radial and tangential terms, of points at depth one, in pixels."""

    def project(points: np.ndarray) -> np.ndarray:
        x, y = points
        squared = x**2 + y**2
        stretch = 1 + squared * (k1 + squared * k2)
        across = x * stretch + 2 * p1 * x * y + p2 * (squared + 2 * x**2)
        down = y * stretch + p1 * (squared + 2 * y**2) + 2 * p2 * x * y
        return np.stack([FOCAL[0] * across + CENTER[0], FOCAL[1] * down + CENTER[1]])

    return project


def fisheye(*coefficients: float) -> Project:
    """Kannala and Brandt's model: the angle from the axis, and odd powers of it, becomes the radius."""

    def project(points: np.ndarray) -> np.ndarray:
        radius = np.hypot(*points) + 1e-12
        angle = np.arctan(radius)
        bent = angle + sum(k * angle ** (2 * power + 3) for power, k in enumerate(coefficients))
        return np.array(FOCAL)[:, None] * points / radius * bent + np.array(CENTER)[:, None]

    return project


LENSES = {
    "barrel": ((-0.2, 0.03, 0.0, 0.0, 0.0), False, perspective(-0.2, 0.03, 0.0, 0.0)),
    "pincushion": ((0.15, 0.05, 0.0, 0.0, 0.0), False, perspective(0.15, 0.05, 0.0, 0.0)),
    "tangential": ((-0.1, 0.0, 0.02, -0.03, 0.0), False, perspective(-0.1, 0.0, 0.02, -0.03)),
    "fisheye": ((0.05, -0.01, 0.002, 0.0), True, fisheye(0.05, -0.01, 0.002, 0.0)),
    "bare fisheye": ((0.0, 0.0, 0.0, 0.0), True, fisheye()),
}


def pixel_centers(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()])


def scene(points: np.ndarray) -> np.ndarray:
    """A smooth picture on the plane at depth one: waves some 25 pixels long, so that half a pixel is 8 levels."""
    x, y = points
    waves = [np.sin(13 * x) * np.cos(4 * y), np.sin(12 * y + 1), np.cos(10 * x - 8 * y)]
    return np.round(127 + 70 * np.stack(waves, axis=-1)).astype(np.uint8)


def photograph(project: Project) -> np.ndarray:
    """What the lens makes of the scene: for each pixel the point that it images, by fixed-point iteration."""
    pixels, points = pixel_centers(), np.zeros((2, WIDTH * HEIGHT))
    for _ in range(100):
        points += (pixels - project(points)) / np.array(FOCAL)[:, None]
    assert np.abs(project(points) - pixels).max() < 1e-5
    return scene(points).reshape(HEIGHT, WIDTH, 3)


def plane_points(lens: Lens | Camera) -> np.ndarray:
    """Where a pinhole's pixels look, on the plane at depth one."""
    pixels = pixel_centers(lens.width, lens.height)
    return (pixels - np.array(lens.principal)[:, None]) / np.array(lens.focal)[:, None]


@pytest.fixture(scope="module", params=LENSES)
def taken(request: pytest.FixtureRequest) -> tuple[Lens, Project, np.ndarray]:
    distortion, bent, project = LENSES[request.param]
    return Lens(FOCAL, CENTER, WIDTH, HEIGHT, distortion, bent), project, photograph(project)


def test_straight_pictures_show_the_scene_of_a_pinhole(taken: tuple[Lens, Project, np.ndarray]) -> None:
    lens, _, image = taken
    straight, pinhole = undistort(image, lens)
    error = np.abs(straight.reshape(-1, 3).astype(float) - scene(plane_points(pinhole)))
    # Bilinear interpolation of such waves errs by 1 level on average; without its half pixel it errs by 5.
    assert error.mean() < 1.5
    bent = np.abs(image.reshape(-1, 3).astype(float) - scene(plane_points(lens)))
    assert bent.mean() > 4 * error.mean()


def test_every_pixel_shows_something_and_little_is_lost(taken: tuple[Lens, Project, np.ndarray]) -> None:
    lens, project, image = taken
    _, pinhole = undistort(image, lens)

    def beyond(zoom: float) -> float:
        """By how many pixels the pinhole, zoomed out, reaches past the lens's outermost pixel centers."""
        across, down = project(plane_points(pinhole) / zoom)
        low = min((across - 0.5).min(), (down - 0.5).min())
        high = max((across - WIDTH + 0.5).max(), (down - HEIGHT + 0.5).max())
        return max(-low, high)

    assert beyond(1.0) < 0.01
    # A hundredth wider would show what the photograph lacks.
    assert beyond(0.99) > 0.1


def test_a_pinhole_is_left_as_it_is() -> None:
    image = scene(plane_points(Lens(FOCAL, CENTER, WIDTH, HEIGHT))).reshape(HEIGHT, WIDTH, 3)
    lens = Lens(FOCAL, CENTER, WIDTH, HEIGHT, (0.0, 0.0, 0.0, 0.0, 0.0))
    straight, pinhole = undistort(image, lens)
    assert np.array_equal(straight, image)
    assert (pinhole.focal, pinhole.principal) == (FOCAL, CENTER)


@pytest.mark.parametrize("distortion", [(-3.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, -900.0)])
def test_coefficients_that_fold_the_image_are_zoomed_away_or_refused(distortion: tuple[float, ...]) -> None:
    """x (1 + k r²) turns back at r² = -1 / 3k; all that the pinhole shows lies within, or nothing does."""
    lens = Lens((14.0, 14.0), (32.0, 24.0), WIDTH, HEIGHT, distortion, origin=Location("cameras.txt", item="camera 3"))
    image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    with raises(CaptureError, file="cameras.txt", name="distortion", value=distortion):
        undistort(image, lens)
    milder = Lens((54.0, 54.0), (32.0, 24.0), WIDTH, HEIGHT, (-0.9, 0.0, 0.0, 0.0, 0.0))
    _, pinhole = undistort(image, milder)
    assert np.square(plane_points(pinhole)).sum(axis=0).max() < 1 / 2.7


def test_folders_with_distorted_images_give_pinholes(tmp_path: Path) -> None:
    """By way of a COLMAP model: the order of its parameters, the images and the cameras."""
    coefficients = (-0.2, 0.03, 0.0, 0.0)
    image = photograph(perspective(*coefficients))
    names = ["a.png", "b.png", "c.png"]
    for name in names:
        write_image(tmp_path / "images" / name, image)
    write_colmap_text(tmp_path, ring(3), names, ("OPENCV", (*FOCAL, *CENTER, *coefficients)))
    cameras = (tmp_path / "cameras.txt").read_text()
    (tmp_path / "cameras.txt").write_text(cameras.replace(" 40 30 ", f" {WIDTH} {HEIGHT} "))
    for longest, tolerance in ((None, 1.5), (32, 4.0)):
        view: View = read_views(tmp_path, longest=longest)[0]
        camera = view.camera
        expected = scene(plane_points(camera)).reshape(camera.height, camera.width, 3)
        # At half the size a pixel averages over a sixth of a wave.
        assert np.abs(view.image.numpy().astype(float) - expected).mean() < tolerance
