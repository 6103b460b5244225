"""transforms.json: axes, intrinsics, poses, file names and masks as the tools that write it mean them."""

import math
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs import read_sparse_points, read_views
from avmsf.photographs.cameras import Camera, View
from avmsf.photographs.folder import write_views
from avmsf.photographs.nerf_json import read_transforms
from factories.raising import raises, warns
from factories.views_folder import HEIGHT, WIDTH, frames, opengl_pose, ring, write_image, write_transforms

LARGE = 10**400
"""Beyond every float."""
POSE = opengl_pose(ring(4)[1])
SHEARED = pytest.approx([1.05, 1, 0.95], abs=0.02)
"""Scales along its axes of the rotation whose x leans by a tenth of y."""


def pose(matrix: np.ndarray) -> dict[str, Any]:
    return {"transform_matrix": matrix.tolist()}


def test_without_rotation_a_camera_looks_down_z_with_x_right_and_y_up(tmp_path: Path) -> None:
    # By hand: the first at z = 5 with no rotation.
    right = [[0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]  # at x = 5, backward is +x
    left = [[0, 0, -1, -5], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
    poses = {"a": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]], "b": right, "c": left}
    rows = [{"file_path": f"images/{name}.png", "transform_matrix": pose} for name, pose in poses.items()]
    folder = write_transforms(tmp_path, rows)
    views = read_views(folder)
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    pixels, depth = views[0].camera.project(points)
    # Focal lengths 50 and 52 over a depth of 5; rows count downwards.
    expected = torch.tensor([[19.0, 16.0], [29.0, 16.0], [19.0, 16.0 - 10.4]], dtype=torch.float64)
    assert torch.allclose(pixels, expected, atol=1e-9)
    assert torch.allclose(depth, torch.full((3,), 5.0, dtype=torch.float64))
    # A unit scales positions and nothing else.
    for one, other in zip(views, read_views(folder, meters=0.01), strict=True):
        assert torch.allclose(other.camera.position, one.camera.position / 100, atol=1e-15)
        assert torch.equal(other.camera.world_to_camera[:3, :3], one.camera.world_to_camera[:3, :3])
        assert other.camera.focal == one.camera.focal


def test_intrinsics_of_a_frame_go_before_those_of_the_file(tmp_path: Path) -> None:
    rows = frames(ring(3))
    rows[1] |= {"fl_x": 70.0, "cx": 20.5}
    views = read_views(write_transforms(tmp_path, rows))
    assert [view.camera.focal for view in views] == [(50.0, 52.0), (70.0, 52.0), (50.0, 52.0)]
    assert views[1].camera.principal == (20.5, 16.0)


def test_an_angle_of_view_stands_for_the_focal_length(tmp_path: Path) -> None:
    """The synthetic NeRF scenes: no size, no suffix, a leading ./ and the horizontal angle alone."""
    rows = frames(ring(3))
    for row in rows:
        write_image(tmp_path / row["file_path"])
        row["file_path"] = "./" + row["file_path"].removesuffix(".png")
    nothing = dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy"))
    write_transforms(tmp_path, rows, images=False, **nothing, camera_angle_x=2 * math.atan(0.4))
    camera = read_views(tmp_path)[0].camera
    # tan of half the angle is .4: 20 pixels beside the middle at 50 pixels' distance, and pixels are square.
    assert camera.focal == pytest.approx((50.0, 50.0))
    assert camera.principal == (WIDTH / 2, HEIGHT / 2)
    write_transforms(tmp_path, rows, images=False, **nothing, camera_angle_x=2 * math.atan(0.4), camera_angle_y=1.0)
    assert read_views(tmp_path)[0].camera.focal == pytest.approx((50.0, 15 / math.tan(0.5)))
    write_transforms(tmp_path, rows, images=False, **nothing, camera_angle_x=50.0)
    with raises(CaptureError, file="transforms.json", row=0, name="camera_angle_x", value=50.0):
        read_views(tmp_path)


def test_names_sort_and_lose_the_images_folder(tmp_path: Path) -> None:
    # instant-ngp's own script writes paths out of the folder where the images lie elsewhere.
    names = ("images/z.png", "./images/b/y.png", "images\\b\\x.png", "images/B.png", "../shots/a.png")
    rows = frames(ring(5))
    for row, name in zip(rows, names, strict=True):
        write_image(tmp_path / "one" / name.replace("\\", "/"))
        row["file_path"] = name
    write_transforms(tmp_path / "one", rows, images=False)
    found = [view.name for view in read_views(tmp_path / "one")]
    assert found == ["B.png", "b/x.png", "b/y.png", "shots/a.png", "z.png"]


def test_a_file_may_be_named_itself(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(3)))
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    assert len(read_views(tmp_path / "transforms_train.json")) == 3
    for name, value in ((".", ["transforms_train.json"]), ("images", []), ("no", None), ("no.json", None)):
        with raises(CaptureError, file=tmp_path / name, value=value):
            read_views(tmp_path / name)


def test_coefficients_go_where_opencv_has_them(tmp_path: Path) -> None:
    """The file names them k1 to k4, p1 and p2; OpenCV orders k1 k2 p1 p2 k3, or k1 to k4 of a fisheye."""
    rows = frames(ring(3))
    rows[1] |= {"camera_model": "OPENCV_FISHEYE", "k4": 0.4}
    rows[2] |= {"is_fisheye": True, "k4": 0.4}
    write_transforms(tmp_path, rows, k1=0.1, k2=0.2, k3=0.3, p1=0.01, p2=0.02)
    perspective, *fisheyes = (each.lens_of(1, 1) for each in read_transforms(tmp_path / "transforms.json").photographs)
    assert (perspective.distortion, perspective.fisheye) == ((0.1, 0.2, 0.01, 0.02, 0.3), False)
    assert [(each.distortion, each.fisheye) for each in fisheyes] == [((0.1, 0.2, 0.3, 0.4), True)] * 2


def test_masks_by_name_and_by_path(tmp_path: Path) -> None:
    rows = frames(ring(4))
    rows[0]["mask_path"] = "elsewhere/m.png"
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    for column, place in enumerate(("elsewhere/m.png", "masks/b.png", "masks/c.png.png"), start=1):
        mask[:] = 0
        mask[:, column] = 255
        write_image(tmp_path / place, mask)
    views = read_views(write_transforms(tmp_path, rows))
    for column, view in enumerate(views[:3], start=1):
        assert view.mask.sum(dim=0).nonzero().flatten().tolist() == [column]
    assert views[3].mask is None


def test_points_that_the_file_names(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(3)), ply_file_path="sparse.ply")
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    header += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    (tmp_path / "sparse.ply").write_text(header + "1 2 3 255 0 7\n-1 0 0.5 1 2 3\n")
    found = read_sparse_points(tmp_path, meters=0.1)
    points, colors = found
    assert torch.allclose(points, torch.tensor([[0.1, 0.2, 0.3], [-0.1, 0.0, 0.05]], dtype=torch.float64))
    assert colors.tolist() == [[255, 0, 7], [1, 2, 3]]


def test_a_model_beside_the_file_is_in_another_frame_and_left_alone(tmp_path: Path) -> None:
    write_transforms(tmp_path, frames(ring(3)))
    (tmp_path / "sparse").mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (tmp_path / "sparse" / name).write_text("1 0 0 0 1 2 3 0.1\n")
    assert read_sparse_points(tmp_path) is None


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        ({"transform_matrix": None}, "transform_matrix", None),
        ({"transform_matrix": "one"}, "transform_matrix", "one"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, "transform_matrix", [[1, 0], [0, 1]]),
        ({"file_path": None}, "file_path", None),
        ({"mask_path": "a\0.png"}, "mask_path", "a\0.png"),
        ({"fl_x": "wide"}, "fl_x", "wide"),
        ({"fl_x": -50.0}, "intrinsics", [-50.0, 52.0, 19.0, 16.0, 0, 0, 0, 0, 0, 40, 30]),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model", "EQUIRECTANGULAR"),
        ({"k4": 0.1}, "k4", 0.1),
        ({"fl_x": LARGE}, "fl_x", LARGE),
        # Left-handed axes.
        *((pose(POSE * mirror), "transform_matrix", pytest.approx(-1)) for mirror in 1 - 2 * np.eye(4)[:3]),
        (pose(POSE + 0.1 * np.outer(np.eye(4)[0], np.eye(4)[1])), "transform_matrix", SHEARED),
        (pose(POSE * [1.1, 1, 1, 1]), "transform_matrix", pytest.approx([1.1, 1, 1])),
        (pose(POSE * [1, 1, 1, np.nan]), "transform_matrix", pytest.approx(np.nan, nan_ok=True)),
        (pose(POSE.T), "transform_matrix", pytest.approx([*POSE[:3, 3], 1.0])),
        ({"file_path": "./images/a.png"}, "a.png", None),
        ({"fl_x": "absent", "fl_y": "absent"}, "fl_x", None),
    ],
)
def test_what_a_frame_lacks_is_named(tmp_path: Path, change: dict, name: str, value: Any) -> None:
    rows = frames(ring(4), fl_x=50.0, fl_y=52.0)
    write_transforms(tmp_path, rows)
    rows[1] = {key: value for key, value in (rows[1] | change).items() if value != "absent"}
    with raises(CaptureError, file="transforms.json", name=name) as caught:
        read_views(write_transforms(tmp_path, rows, images=False, fl_x=None, fl_y=None))
    assert (caught.value.row, caught.value.value) == (1, value) or name == "a.png"


@pytest.mark.parametrize(
    ("text", "given", "name", "value"),
    [
        ('{"frames": [', {}, None, None),
        ("[1, 2]", {}, None, "list"),
        ('{"frames": 3}', {}, "frames", "int"),
        ("[" * 100_000, {}, None, None),
        (None, {"longest": 0}, "longest", 0),
        (None, {"meters": -1.0}, "meters", -1.0),
    ],
    ids=["cut", "list", "number", "deep", "longest", "meters"],
)
def test_what_is_no_json_object_with_frames_is_named(tmp_path: Path, text, given, name, value) -> None:
    write_transforms(tmp_path, frames(ring(3)))
    if text is not None:
        (tmp_path / "transforms.json").write_text(text)
    with raises(CaptureError, file=None if given else "transforms.json", name=name, value=value):
        read_views(tmp_path, **given)


def some_views(*, masked: bool = True) -> tuple[View, ...]:
    generator, views, up = torch.Generator().manual_seed(0), [], torch.tensor([0.0, 0.0, 1.0])
    for number in range(4):
        position = 3 * torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
        camera = Camera.looking(position, torch.zeros(3), up=up, focal=40.0 + number, width=24, height=17)
        pixels = torch.randint(0, 256, (17, 24, 4), generator=generator, dtype=torch.uint8)
        mask = pixels[..., 3].contiguous() if masked else None
        views.append(View(f"side/{number}.jpg", pixels[..., :3].contiguous(), camera, mask))
    return tuple(views)


@pytest.mark.parametrize("masked", [True, False])
def test_views_are_read_back_as_they_were(tmp_path: Path, masked: bool) -> None:
    views = some_views(masked=masked)
    write_views(views, tmp_path / "views")
    for before, after in zip(views, read_views(tmp_path / "views"), strict=True):
        assert after.name == before.name.replace(".jpg", ".png")
        assert torch.equal(after.image, before.image)
        assert (after.mask is None) == (not masked)
        if before.mask is not None and after.mask is not None:
            assert torch.equal(after.mask, before.mask)
        assert after.camera.focal == before.camera.focal
        assert after.camera.principal == before.camera.principal
        # Two inversions in float64, of matrices of size 3.
        assert (after.camera.world_to_camera - before.camera.world_to_camera).abs().max() < 1e-12


def test_views_of_one_name_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    views = some_views()
    with raises(CaptureError, file="views", name="side/0.png"):
        write_views([views[0], views[0]], tmp_path / "views")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_holds_something_is_left_alone_or_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "views"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")
    with raises(CaptureError, file=folder):
        write_views(some_views(), folder)
    assert [each.name for each in folder.iterdir()] == ["mine.txt"]
    write_views(some_views(), folder, replace=True)
    assert sorted(each.name for each in folder.iterdir()) == ["images", "masks", "transforms.json"]
    assert [each.name for each in tmp_path.iterdir()] == ["views"]


def with_poses(folder: Path, change) -> Path:
    """A ring of four whose poses went through `change`."""
    rows = frames(ring(4))
    for row in rows:
        row["transform_matrix"] = change(np.array(row["transform_matrix"])).tolist()
    return write_transforms(folder, rows)


SCALED = [f"{name}.png (0.25)" for name in "abcd"]


@pytest.mark.parametrize(
    ("change", "tolerance", "scaled"),
    [
        (lambda pose: pose[:3], 1e-12, None),
        # Four digits leave half a ten-thousandth in each number.
        (lambda pose: pose.round(4), 4e-4, None),
        (lambda pose: pose * [0.25, 0.25, 0.25, 1], 1e-12, SCALED),
    ],
    ids=["three rows", "rounded", "scaled"],
)
def test_poses_become_rigid_where_they_stand(tmp_path: Path, change, tolerance: float, scaled: list | None) -> None:
    folder = with_poses(tmp_path, change)
    name = {"name": "transform_matrix", "value": scaled}
    with warns(CaptureWarning, file="transforms.json", **name) if scaled else nullcontext():
        views = read_views(folder)
    for view, camera in zip(views, ring(4), strict=True):
        rotation = view.camera.world_to_camera[:3, :3]
        assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
        assert torch.allclose(view.camera.world_to_camera, camera.world_to_camera, atol=tolerance)


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        # The axes of OpenCV, by which cameras look away from the object.
        (lambda pose: pose * [1, -1, -1, 1], "axes", 4),
        (lambda pose: np.column_stack([pose[:, :3], [1, 2, 3, 1]]), "positions", [1.0, 2.0, 3.0]),
    ],
)
def test_cameras_that_look_away_or_share_one_position_are_warned_of(tmp_path: Path, change, name, value) -> None:
    with warns(CaptureWarning, file="transforms.json", name=name, value=value):
        read_views(with_poses(tmp_path, change))


def test_cameras_side_by_side_are_right(tmp_path: Path) -> None:
    """Parallel axes meet nowhere, which says nothing against them."""
    rows, pose = frames(ring(4)), opengl_pose(ring(4)[0])
    for step, row in enumerate(rows):
        pose[:3, 3] += step * pose[:3, 0]
        row["transform_matrix"] = pose.tolist()
    assert len(read_views(write_transforms(tmp_path, rows))) == 4
