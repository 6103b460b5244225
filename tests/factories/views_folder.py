"""Folders of views written by the tests, in each format, from cameras on a ring."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avmsf.photographs.cameras import Camera

WIDTH, HEIGHT = 40, 30
MODEL_NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FOV": 7}
Parameters = tuple[str, tuple[float, ...]]
PINHOLE: Parameters = ("PINHOLE", (50.0, 52.0, 19.0, 16.0))


def ring(count: int, *, radius: float = 2.0, width: int = WIDTH, height: int = HEIGHT) -> list[Camera]:
    """Cameras around the z axis that look at the origin from somewhat above."""
    cameras = []
    for angle in np.arange(count) * 2 * np.pi / count:
        position = torch.tensor([radius * np.cos(angle), radius * np.sin(angle), 0.4 * radius])
        up = torch.tensor([0.0, 0.0, 1.0])
        cameras.append(Camera.looking(position, torch.zeros(3), up=up, focal=50.0, width=width, height=height))
    return cameras


def opengl_pose(camera: Camera) -> np.ndarray:
    """The camera's right, up and backward axes and its position, column by column."""
    pose = np.eye(4)
    right, down, forward = camera.world_to_camera[:3, :3].numpy()
    pose[:3] = np.stack([right, -down, -forward, camera.position.numpy()], axis=1)
    return pose


def write_image(path: Path, image: np.ndarray | None = None) -> None:
    """Red, green, blue (and alpha); by default noise that differs from file to file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image is None:
        seed = sum(map(ord, path.name))
        image = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    if image.ndim == 3:
        image = image[..., [2, 1, 0, 3][: image.shape[2]]]
    assert cv2.imwrite(str(path), image)


def frames(cameras: Sequence[Camera], **settings: Any) -> list[dict[str, Any]]:
    """transforms.json's frames, the images a.png, b.png and so on in images/."""
    return [
        {"file_path": f"images/{chr(97 + row)}.png", "transform_matrix": opengl_pose(camera).tolist()} | settings
        for row, camera in enumerate(cameras)
    ]


def write_transforms(folder: Path, rows: list[dict[str, Any]], *, images: bool = True, **settings: Any) -> Path:
    """A transforms.json with the intrinsics of PINHOLE at its top, and images."""
    focal_x, focal_y, cx, cy = PINHOLE[1]
    top = {"w": WIDTH, "h": HEIGHT, "fl_x": focal_x, "fl_y": focal_y, "cx": cx, "cy": cy} | settings
    record = {key: value for key, value in top.items() if value is not None} | {"frames": rows}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(record))
    if images:
        for row in rows:
            write_image(folder / row["file_path"])
    return folder


def quaternion(camera: Camera) -> tuple[float, float, float, float]:
    """w, x, y, z of world to camera."""
    x, y, z, w = Rotation.from_matrix(camera.world_to_camera[:3, :3].numpy()).as_quat()
    return (float(w), float(x), float(y), float(z))


def write_colmap_text(model: Path, cameras: Sequence[Camera], names: Sequence[str], lens: Parameters = PINHOLE) -> None:
    model.mkdir(parents=True, exist_ok=True)
    kind, parameters = lens
    numbers = " ".join(map(repr, parameters))
    (model / "cameras.txt").write_text(f"# Camera list\n7 {kind} {WIDTH} {HEIGHT} {numbers}\n")
    lines = ["# Image list with two lines of data per image:"]
    for row, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        pose = " ".join(repr(float(value)) for value in (*quaternion(camera), *camera.world_to_camera[:3, 3]))
        lines += [f"{row} {pose} 7 {name}", "1.5 2.5 -1 10.0 11.0 3" if row % 2 else ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text("# 3D points\n1 0.5 -0.25 2 255 128 0 0.7 1 0 2 0\n2 1 2 3 1 2 3 0.1\n")


def write_colmap_binary(
    model: Path, cameras: Sequence[Camera], names: Sequence[str], lens: Parameters = PINHOLE
) -> None:
    model.mkdir(parents=True, exist_ok=True)
    kind, parameters = lens
    header = struct.pack("<QIiQQ", 1, 7, MODEL_NUMBERS[kind], WIDTH, HEIGHT)
    (model / "cameras.bin").write_bytes(header + struct.pack(f"<{len(parameters)}d", *parameters))
    content = struct.pack("<Q", len(names))
    for row, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        pose = (*quaternion(camera), *camera.world_to_camera[:3, 3].tolist())
        content += struct.pack("<I7dI", row, *pose, 7) + name.encode() + b"\0"
        features = [(1.5, 2.5, -1), (10.0, 11.0, 3)][: row % 3]
        content += struct.pack("<Q", len(features)) + b"".join(struct.pack("<ddq", *feature) for feature in features)
    (model / "images.bin").write_bytes(content)
    points = struct.pack("<Q", 2)
    points += struct.pack("<Q3d3BdQ4I", 1, 0.5, -0.25, 2.0, 255, 128, 0, 0.7, 2, 1, 0, 2, 0)
    points += struct.pack("<Q3d3BdQ", 2, 1.0, 2.0, 3.0, 1, 2, 3, 0.1, 0)
    (model / "points3D.bin").write_bytes(points)
