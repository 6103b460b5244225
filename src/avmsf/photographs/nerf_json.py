"""`transforms.json` as nerfstudio, instant-ngp and the synthetic NeRF scenes write it."""

import math
import sys
from collections import ChainMap
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from avmsf._utils.text import read_json_object
from avmsf.capture.filenames import PICTURE_SUFFIXES
from avmsf.errors import CaptureError
from avmsf.mesh.io import load_parts
from avmsf.photographs.lenses import CameraFile, Lens, Location, Photograph

PERSPECTIVE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Axes of cameras: y and z the other way; its own inverse."""
MAX_SCALE_DEVIATION = 1e-3
"""Of a rotation: poses written with four digits, or that drifted by rounding, pass; shears and scales do not."""


def read_transforms(path: Path) -> CameraFile:
    """Read the photographs of a transforms.json; paths in it count from its folder.

    Poses are camera to world with OpenGL's axes; intrinsics stand at the top or in each frame. Raises CaptureError
    where the file is not JSON, lacks something, or holds a pose or a camera model that cannot be used.
    """
    record = read_json_object(path, raising=CaptureError)
    frames = record.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        wanted, kind = "a list 'frames', each with file_path and transform_matrix", type(frames).__name__
        raise CaptureError.expected(wanted, kind, got=kind, file=path, name="frames")
    common = {key: value for key, value in record.items() if key != "frames"}
    photographs, scaled = [], []
    for row, frame in enumerate(frames):
        file = _text(frame, "file_path", Location(path, row, f"frame {row}"))
        where = Location(path, row, f"frame {row} ({file})")
        pose, scale = _rigid_pose(frame, where)
        image = _with_suffix(path.parent / file)
        name = _name(file, image)
        if abs(scale - 1) > MAX_SCALE_DEVIATION:
            scaled.append(f"{name} ({scale:.4g})")
        settings = ChainMap(frame, common)
        mask = path.parent / _text(frame, "mask_path", where) if frame.get("mask_path") else None
        lens_of = partial(_lens, settings, where, _is_fisheye(settings, where))
        world_to_camera = torch.from_numpy(np.linalg.inv(pose @ OPENCV_FROM_OPENGL))
        photographs.append(Photograph(name, image, world_to_camera, lens_of, mask))
    return CameraFile(path, path.parent, tuple(photographs), tuple(scaled))


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the points [points, 3] of the file that a transforms.json names, and their colors [points, 3] in 8 bits.

    Gray where they have none; None where it names no file or there are no points.
    """
    cloud = points_file(path)
    if cloud is None:
        return None
    clouds: list[Any] = load_parts(cloud)
    if len(clouds) != 1:
        got, key = f"{len(clouds)} parts", "ply_file_path"
        raise CaptureError.expected("one point cloud", len(clouds), got=got, file=cloud, name=key)
    points = np.asarray(clouds[0].vertices, dtype=np.float64)
    colors = np.full((len(points), 3), 128, dtype=np.uint8)
    painted = np.asarray(getattr(clouds[0].visual, "vertex_colors", colors))
    if painted.shape[:1] == points.shape[:1]:
        colors = painted[:, :3].astype(np.uint8)
    return (points, colors) if len(points) else None


def points_file(path: Path) -> Path | None:
    """Return the file of points that a transforms.json names; None where it names none."""
    named = read_json_object(path, raising=CaptureError).get("ply_file_path")
    return path.parent / named.replace("\\", "/") if isinstance(named, str) and named else None


def _lens(settings: Mapping[str, Any], where: Location, fisheye: bool, image_width: int, image_height: int) -> Lens:
    """Return a frame's lens; the image's size is used where the file has none."""
    sized = "w" in settings and "h" in settings
    width = int(_number(settings, "w", where)) if sized else image_width
    height = int(_number(settings, "h", where)) if sized else image_height
    across, down = _focal(settings, "x", width, where), _focal(settings, "y", height, where)
    if across is None and down is None:
        raise where.expected("fl_x or camera_angle_x, in the frame or at the top of the file", name="fl_x")
    # With one focal length alone, pixels are square.
    focal = (across or down or 0.0, down or across or 0.0)
    principal = (_number(settings, "cx", where, width / 2), _number(settings, "cy", where, height / 2))
    k1, k2, k3, k4, p1, p2 = (_number(settings, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if not fisheye and k4:
        wanted, got = "k1 k2 p1 p2 k3 of a perspective lens", f"k4 = {k4}"
        raise where.expected(wanted, k4, got=got, name="k4", advice="calibrate again")
    distortion = (k1, k2, k3, k4) if fisheye else (k1, k2, p1, p2, k3)
    return Lens(focal, principal, width, height, distortion, fisheye, where)


def _focal(settings: Mapping[str, Any], axis: str, pixels: int, where: Location) -> float | None:
    if f"fl_{axis}" in settings:
        return _number(settings, f"fl_{axis}", where)
    key = f"camera_angle_{axis}"
    if key not in settings:
        return None
    angle = _number(settings, key, where)
    if not 0 < angle < math.pi:
        raise where.expected(f"{key} in radians between 0 and pi", angle, name=key)
    return pixels / 2 / math.tan(angle / 2)


def _is_fisheye(settings: Mapping[str, Any], where: Location) -> bool:
    """Whether the frame's camera model is fisheye; raises CaptureError unless it is that or perspective."""
    name = str(settings.get("camera_model") or (FISHEYE if settings.get("is_fisheye") else PERSPECTIVE)[0]).upper()
    if name not in PERSPECTIVE + FISHEYE:
        wanted = f"a camera model among {', '.join(PERSPECTIVE + FISHEYE)}"
        raise where.expected(wanted, name, name="camera_model", advice="undistort the images first")
    return name in FISHEYE


def _number(settings: Mapping[str, Any], key: str, where: Location, fallback: float | None = None) -> float:
    value = settings.get(key, fallback)
    # A whole number of a JSON file may be larger than any float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise where.expected(f"a finite number as {key}", value, name=key)
    return float(value)


def _text(frame: dict[str, Any], key: str, where: Location) -> str:
    value = frame.get(key)
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise where.expected(f"the path of a file as {key}", value, name=key)
    return value.replace("\\", "/")


def _with_suffix(path: Path) -> Path:
    """Return the file itself, or the image file of that name where the suffix was left out."""
    if path.suffix.lower() in PICTURE_SUFFIXES or path.is_file():
        return path
    spellings = [path.with_name(path.name + suffix) for small in PICTURE_SUFFIXES for suffix in (small, small.upper())]
    return next((spelling for spelling in spellings if spelling.is_file()), path)


def _name(file: str, image: Path) -> str:
    """Return the image's path without a leading `./`, `../` or `images/`, with its suffix."""
    stem = PurePosixPath(file)
    if stem.is_absolute() or Path(file).is_absolute():
        return image.name
    parts = [part for part in stem.parts[:-1] if part not in (".", "..")]
    return "/".join([*(parts[1:] if parts[:1] == ["images"] else parts), image.name])


def _rigid_pose(frame: dict[str, Any], where: Location) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Return a frame's camera-to-world matrix, made exactly rigid, and the scale that its rotation had on all axes."""
    key, wanted = "transform_matrix", "the camera-to-world pose as 4 rows of 4 numbers"
    written = frame.get(key)
    try:
        matrix = np.array(written, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise where.expected(wanted, written, got=str(error), name=key) from error
    if matrix.shape not in ((4, 4), (3, 4)):
        got = None if written is None else f"the shape {matrix.shape}"
        raise where.expected(wanted, written, got=got, name=key)
    if not np.isfinite(matrix).all():
        value = float(matrix[~np.isfinite(matrix)][0])
        raise where.expected("a finite pose", value, name=key, advice="estimate this camera again")
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        wanted, row, advice = "0 0 0 1 as the pose's last row", matrix[3].tolist(), "perhaps the matrix is transposed"
        raise where.expected(wanted, row, name=key, advice=advice)
    determinant = float(np.linalg.det(matrix[:3, :3]))
    if determinant < -1e-12:
        got = f"determinant {determinant:.3g}"
        advice = (
            "transforms.json has OpenGL's axes: x right, y up, z backward. With y up and z forward (Unity, DirectX), "
            "negate the third column; with x right, y down and z forward (OpenCV), negate the second and the third"
        )
        raise where.expected("a pose with right-handed axes", determinant, got=got, name=key, advice=advice)
    left, stretches, right = np.linalg.svd(matrix[:3, :3])
    scale = float(stretches.mean())
    if scale < 1e-9 or np.abs(stretches / scale - 1).max() > MAX_SCALE_DEVIATION:
        got = f"the scales {', '.join(f'{stretch:.4g}' for stretch in stretches)} along its axes"
        wanted, advice = "a rotation in the pose", "remove the scales"
        raise where.expected(wanted, stretches.tolist(), got=got, name=key, advice=advice)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, matrix[:3, 3]
    return rigid, scale
