"""COLMAP's models: text, binary and what COLMAP itself writes say the same as transforms.json."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch

from avmsf.errors import CaptureError
from avmsf.photographs import read_sparse_points, read_views
from avmsf.photographs.cameras import View
from avmsf.photographs.colmap import MODELS, read_colmap, read_lenses
from factories.raising import raises
from factories.views_folder import (
    HEIGHT,
    WIDTH,
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


def assert_same(ones: tuple[View, ...], others: tuple[View, ...]) -> None:
    assert [view.name for view in ones] == [view.name for view in others]
    for one, other in zip(ones, others, strict=True):
        # A quaternion's rounding in float64.
        assert (one.camera.world_to_camera - other.camera.world_to_camera).abs().max() < 1e-14
        assert one.camera.focal == other.camera.focal
        assert one.camera.principal == other.camera.principal
        assert torch.equal(one.image, other.image)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
@pytest.mark.parametrize("write", WRITERS)
def test_models_say_the_same_as_transforms(tmp_path: Path, write: Callable[..., None], place: str) -> None:
    names = ["A/upper ring/a 1.png", *NAMES[1:]]
    write_images(tmp_path / "one", names)
    write(tmp_path / "one" / place, ring(4), names)
    rows = frames(ring(4))
    rows[0]["file_path"] = f"images/{names[0]}"
    write_transforms(tmp_path / "other", rows)
    assert_same(read_views(tmp_path / "one"), read_views(tmp_path / "other"))


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
    assert (lens.width, lens.height, lens.principal) == (WIDTH, HEIGHT, (19.0, 16.0))
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
def test_malformed_text_is_named_by_line(
    tmp_path: Path, file: str, before: str, after: str, row: int | None, name: str | None
) -> None:
    read = read_sparse_points if file == "points3D.txt" else read_views
    write_colmap_text(tmp_path, ring(4), NAMES)
    text = (tmp_path / file).read_text()
    assert before in text
    (tmp_path / file).write_text(text.replace(before, after, 1))
    with raises(CaptureError, file=file, row=row, name=name):
        read(tmp_path)
