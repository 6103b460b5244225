"""COLMAP's sparse models: cameras, images and points, in text or binary, whichever lies in the folder."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch

from avmsf.errors import CaptureError, Location
from avmsf.photographs.lenses import Lens
from avmsf.photographs.shots import Shot, Shots, refuse_many

PLACES = ("sparse/0", "sparse", ".")
_Row = TypeVar("_Row")


class _Model(NamedTuple):
    """How a camera model's parameters are laid out: focal lengths, then cx cy, then these coefficients."""

    number: int
    """COLMAP's, in binary files."""
    focals: int
    coefficients: tuple[int, ...] = ()
    """Where each parameter after cx cy goes: 0-3 in k1 k2 p1 p2 of a perspective lens, in k1 k2 k3 k4 of a fisheye."""
    fisheye: bool = False

    @property
    def parameters(self) -> int:
        return self.focals + 2 + len(self.coefficients)


MODELS = {
    "SIMPLE_PINHOLE": _Model(0, 1),
    "PINHOLE": _Model(1, 2),
    "SIMPLE_RADIAL": _Model(2, 1, (0,)),
    "RADIAL": _Model(3, 1, (0, 1)),
    "OPENCV": _Model(4, 2, (0, 1, 2, 3)),
    "OPENCV_FISHEYE": _Model(5, 2, (0, 1, 2, 3), fisheye=True),
    "SIMPLE_RADIAL_FISHEYE": _Model(8, 1, (0,), fisheye=True),
    "RADIAL_FISHEYE": _Model(9, 1, (0, 1), fisheye=True),
}
_BINARY_MODELS = {model.number: (name, model.parameters) for name, model in MODELS.items()} | {
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
"""Names and numbers of parameters by COLMAP's number, also of models that are then refused by name."""


class _Camera(NamedTuple):
    number: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class _Image(NamedTuple):
    """One registered image: the rigid transform of the world into its camera."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    """w, x, y, z."""
    translation: tuple[float, ...]


def find_model(folder: Path) -> Path | None:
    """Return the folder that holds a model's cameras and images, the first of the usual ones; None without any."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if (folder / place / f"cameras{suffix}").is_file() and (folder / place / f"images{suffix}").is_file():
                return folder / place
    return None


def read_colmap(model: Path, images: Path) -> Shots:
    """Read the model's shots, whose image files lie in `images`; binary where both forms are there.

    Raises CaptureError for a truncated or malformed file, a camera that an image names and the model lacks, and
    camera models without a pinhole behind OpenCV's distortion.
    """
    if (model / "cameras.bin").is_file() and (model / "images.bin").is_file():
        cameras_file, images_file = model / "cameras.bin", model / "images.bin"
        cameras, records = read_binary_cameras(cameras_file), _read_binary_images(images_file)
    else:
        cameras_file, images_file = model / "cameras.txt", model / "images.txt"
        cameras, records = read_text_cameras(cameras_file), _read_text_images(images_file)
    refuse_many(len(records), images_file)
    lenses = {each.number: _lens(each, Location(cameras_file, item=f"camera {each.number}")) for each in cameras}
    return Shots(model, tuple(_shot(record, lenses, images_file, images) for record in records))


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the model's points [points, 3] and their colors [points, 3] in 8 bits; None where it has no points."""
    for suffix, read in ((".bin", _read_binary_points), (".txt", _read_text_points)):
        path = model / f"points3D{suffix}"
        if path.is_file():
            found = read(path)
            points = np.array([point for point, _ in found], dtype=np.float64).reshape(-1, 3)
            if not np.isfinite(points).all():
                row = int(np.isfinite(points).all(axis=1).argmin())
                raise Location(path, row, f"point {row}").error(
                    f"expected finite coordinates, got {points[row].tolist()}; run the reconstruction again",
                    value=points[row].tolist(),
                )
            return (points, np.array([color for _, color in found], dtype=np.uint8)) if found else None
    return None


def _lens(record: _Camera, where: Location) -> Lens:
    model = MODELS.get(record.model)
    if model is None:
        raise where.error(
            f"expected a camera model among {', '.join(MODELS)}, got {record.model}; undistort the images first "
            "(colmap image_undistorter)",
            name=where.item,
            value=record.model,
        )
    if len(record.parameters) != model.parameters:
        raise where.error(
            f"expected {model.parameters} parameters of {record.model}, got {len(record.parameters)}",
            name=where.item,
            value=len(record.parameters),
        )
    cx, cy, *rest = record.parameters[model.focals :]
    distortion = [0.0] * (4 if model.fisheye else 5)
    for index, value in zip(model.coefficients, rest, strict=True):
        distortion[index] = value
    focal = (record.parameters[0], record.parameters[model.focals - 1])
    return Lens(focal, (cx, cy), record.width, record.height, tuple(distortion), model.fisheye, where)


def _shot(record: _Image, lenses: dict[int, Lens], file: Path, images: Path) -> Shot:
    lens, where = lenses.get(record.camera), Location(file, item=f"image {record.name}")
    if lens is None:
        raise where.error(
            f"expected a camera of the model ({', '.join(map(str, lenses))}), got camera {record.camera}; export all "
            "parts of the model together",
            name=record.name,
            value=record.camera,
        )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(_rotation(record, where))
    pose[:3, 3] = torch.tensor(record.translation, dtype=torch.float64)
    if not bool(torch.isfinite(pose).all()):
        raise where.error(
            f"expected a finite translation, got {record.translation}", name=record.name, value=record.translation
        )
    name = record.name.replace("\\", "/")
    return Shot(name, images / name, pose, lambda _width, _height: lens)


def _rotation(record: _Image, where: Location) -> np.ndarray:
    """Return the matrix of a quaternion w, x, y, z of any length but zero."""
    values = np.array(record.quaternion, dtype=np.float64)
    length = float(np.linalg.norm(values))
    if not np.isfinite(length) or length < 1e-6:
        raise where.error(
            f"expected a rotation's quaternion, got {record.quaternion}; run the mapper again",
            name=record.name,
            value=record.quaternion,
        )
    w, x, y, z = values / length
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # Rodrigues' formula in quaternion form.
    return np.eye(3) + 2 * w * axis + 2 * axis @ axis


class _Reader:
    """The bytes of a binary file, little-endian and packed, taken from the front."""

    def __init__(self, path: Path) -> None:
        self.path, self.place = path, 0
        try:
            self.content = path.read_bytes()
        except OSError as error:
            raise CaptureError.expected(
                "a readable file", error.strerror, file=path, advice="get read permission, or export the model again"
            ) from error

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, laid out as `struct` says."""
        try:
            values = struct.unpack_from("<" + layout, self.content, self.place)
        except struct.error as error:
            raise self.short() from error
        self.place += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """Return the next text, up to a zero byte."""
        end = self.content.find(b"\0", self.place)
        if end < 0:
            raise self.short()
        text = self.content[self.place : end].decode("utf-8", errors="replace")
        self.place = end + 1
        return text

    def skip(self, count: int) -> None:
        """Leave out bytes."""
        if self.place + count > len(self.content):
            raise self.short()
        self.place += count

    def short(self) -> CaptureError:
        return CaptureError(
            f"{self.path}: expected a complete binary COLMAP file, got one that ends after {len(self.content)} bytes "
            "inside a record; copy it again",
            file=self.path,
            value=len(self.content),
        )


def read_binary_cameras(path: Path) -> list[_Camera]:
    """Read cameras.bin; raises CaptureError where it is truncated or names an unknown camera model."""
    reader, records = _Reader(path), []
    for _ in range(*reader.take("Q")):
        number, model, width, height = reader.take("IiQQ")
        if model not in _BINARY_MODELS:
            raise Location(path, item=f"camera {number}").error(
                f"expected a known camera model, got number {model}; undistort the images first (colmap "
                "image_undistorter)",
                name=f"camera {number}",
                value=model,
            )
        name, parameters = _BINARY_MODELS[model]
        records.append(_Camera(number, name, width, height, reader.take(f"{parameters}d")))
    return records


def _read_binary_images(path: Path) -> list[_Image]:
    reader, records = _Reader(path), []
    for _ in range(*reader.take("Q")):
        _, *pose, camera = reader.take("I7dI")
        records.append(_Image(reader.text(), camera, tuple(pose[:4]), tuple(pose[4:])))
        (features,) = reader.take("Q")
        reader.skip(24 * features)
    return records


def _read_binary_points(path: Path) -> list[tuple[Any, Any]]:
    """Read positions and colors from points3D.bin; raises CaptureError where it is truncated."""
    reader, points = _Reader(path), []
    for _ in range(*reader.take("Q")):
        _, *point, red, green, blue, _, track = reader.take("Q3d3BdQ")
        reader.skip(8 * track)
        points.append((point, (red, green, blue)))
    return points


def read_text_cameras(path: Path) -> list[_Camera]:
    """Read cameras.txt; raises CaptureError with the line that is malformed."""
    return [_parsed(path, row, line, _camera) for row, line in _lines(path) if line]


def _read_text_images(path: Path) -> list[_Image]:
    """Read images.txt, two rows an image; raises CaptureError with the line that is malformed."""
    records, features_next = [], False
    for row, line in _lines(path):
        if features_next:
            _parsed(path, row, line, _features)
            features_next = False
        elif line:
            records.append(_parsed(path, row, line, _image))
            features_next = True
    return records


def _read_text_points(path: Path) -> list[tuple[Any, Any]]:
    return [_parsed(path, row, line, _point) for row, line in _lines(path) if line]


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines that are no comments, with their numbers from 1."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise CaptureError.expected(
            "a readable text file", reason, file=path, advice="get read permission, or export the model again as text"
        ) from error
    lines = [(row, line.strip()) for row, line in enumerate(text.splitlines(), start=1)]
    return [(row, line) for row, line in lines if not line.startswith("#")]


def _parsed(path: Path, row: int, line: str, parse: Callable[[str], _Row]) -> _Row:
    try:
        return parse(line)
    except (ValueError, IndexError, OverflowError) as error:
        raise Location(path, row, f"row {row}").error(
            f"expected a row as COLMAP writes it, got {line[:80]!r}; export the model again", value=line
        ) from error


def _camera(line: str) -> _Camera:
    number, model, width, height, *parameters = line.split()
    return _Camera(int(number), model, int(width), int(height), tuple(map(float, parameters)))


def _image(line: str) -> _Image:
    # The name comes last and may hold blanks.
    _, *pose, camera, name = line.split(maxsplit=9)
    w, x, y, z, right, down, ahead = map(float, pose)
    return _Image(name, int(camera), (w, x, y, z), (right, down, ahead))


def _features(line: str) -> None:
    """Refuse what is no list of features, so that no image is taken for one; the features themselves go unused."""
    values = line.split()
    if len(values) % 3:
        raise ValueError(line)
    for value in values[:3]:
        float(value)


def _point(line: str) -> tuple[tuple[float, ...], tuple[int, ...]]:
    _, x, y, z, red, green, blue, *_ = line.split()
    color = (int(red), int(green), int(blue))
    if not all(0 <= value <= 255 for value in color):
        raise ValueError(color)
    return (float(x), float(y), float(z)), color
