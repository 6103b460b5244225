"""Poses that are not rigid are mended or refused, and cameras that cannot all be right are warned of."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs import read_views
from factories.raising import raises, warns
from factories.views_folder import frames, opengl_pose, ring, write_transforms


def with_poses(folder: Path, change) -> Path:
    """A ring of four whose second to fourth poses went through `change`."""
    rows = frames(ring(4))
    for row in rows[1:]:
        row["transform_matrix"] = change(np.array(row["transform_matrix"])).tolist()
    return write_transforms(folder, rows)


def test_a_scaled_rotation_is_mended_where_it_stands(tmp_path: Path) -> None:
    def scale(pose: np.ndarray) -> np.ndarray:
        pose[:3, :3] *= 0.25
        return pose

    scaled = ["b.png (0.25)", "c.png (0.25)", "d.png (0.25)"]
    with warns(CaptureWarning, file="transforms.json", name="transform_matrix", value=scaled):
        views = read_views(with_poses(tmp_path, scale))
    for view, camera in zip(views, ring(4), strict=True):
        assert torch.allclose(view.camera.world_to_camera, camera.world_to_camera, atol=1e-12)


def test_rounded_poses_become_rigid_without_a_word(tmp_path: Path) -> None:
    view = read_views(with_poses(tmp_path, lambda pose: pose.round(4)))[1]
    rotation = view.camera.world_to_camera[:3, :3]
    assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
    # Four digits leave half a ten-thousandth in each number.
    assert torch.allclose(view.camera.world_to_camera, ring(4)[1].world_to_camera, atol=4e-4)


def test_three_rows_are_enough(tmp_path: Path) -> None:
    views = read_views(with_poses(tmp_path, lambda pose: pose[:3]))
    assert torch.allclose(views[3].camera.world_to_camera, ring(4)[3].world_to_camera, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_left_handed_axes_are_refused_with_the_likely_convention(tmp_path: Path, axis: int) -> None:
    def turn(pose: np.ndarray) -> np.ndarray:
        pose[:3, axis] *= -1
        return pose

    with raises(
        CaptureError, file="transforms.json", row=1, name="transform_matrix", value=pytest.approx(-1)
    ) as caught:
        read_views(with_poses(tmp_path, turn))
    assert all(name in str(caught.value) for name in ("OpenGL", "Unity", "OpenCV"))


def shear(pose: np.ndarray) -> np.ndarray:
    pose[0, 1] += 0.1
    return pose


def stretch(pose: np.ndarray) -> np.ndarray:
    pose[:3, 0] *= 1.1
    return pose


def spoil(pose: np.ndarray) -> np.ndarray:
    pose[1, 3] = np.nan
    return pose


def flatten(pose: np.ndarray) -> np.ndarray:
    pose[:3, :3] = 0
    return pose


@pytest.mark.parametrize(
    ("change", "value"),
    [
        (shear, pytest.approx([1.05, 1, 0.95], abs=0.02)),
        (stretch, pytest.approx([1.1, 1, 1])),
        (flatten, [0.0, 0.0, 0.0]),
        (spoil, pytest.approx(np.nan, nan_ok=True)),
        (np.transpose, pytest.approx([*opengl_pose(ring(4)[1])[:3, 3], 1.0])),
    ],
)
def test_what_is_no_rigid_pose_is_refused(tmp_path: Path, change, value: Any) -> None:
    with raises(CaptureError, file="transforms.json", row=1, name="transform_matrix", value=value):
        read_views(with_poses(tmp_path, change))


def test_opencv_axes_in_the_file_make_cameras_look_away(tmp_path: Path) -> None:
    rows = frames(ring(5))
    for row in rows:
        row["transform_matrix"] = (np.array(row["transform_matrix"]) * [1, -1, -1, 1]).tolist()
    with warns(CaptureWarning, file="transforms.json", name="axes", value=5):
        read_views(write_transforms(tmp_path, rows))


def test_cameras_at_one_position_are_warned_of(tmp_path: Path) -> None:
    rows = frames(ring(4))
    for row in rows:
        pose = np.array(row["transform_matrix"])
        pose[:3, 3] = (1.0, 2.0, 3.0)
        row["transform_matrix"] = pose.tolist()
    with warns(CaptureWarning, file="transforms.json", name="positions", value=[1.0, 2.0, 3.0]):
        read_views(write_transforms(tmp_path, rows))


def test_cameras_side_by_side_are_right(tmp_path: Path) -> None:
    """Parallel axes meet nowhere, which says nothing against them."""
    rows = frames(ring(4))
    pose = opengl_pose(ring(4)[0])
    for step, row in enumerate(rows):
        pose[:3, 3] += step * pose[:3, 0]
        row["transform_matrix"] = pose.tolist()
    assert len(read_views(write_transforms(tmp_path, rows))) == 4
