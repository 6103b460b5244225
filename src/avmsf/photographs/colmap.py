"""COLMAP's sparse models: cameras, images and points, in text or binary, whichever lies in the folder."""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

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
_UNDISTORT = "undistort the images first (colmap image_undistorter)"


class _Camera(NamedTuple):
    number: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


class _Image(NamedTuple):
    """One registered image."""

    name: str
    camera: int
    pose: tuple[float, ...]
    """The rotation of the world into its camera as a quaternion w, x, y, z of any length, then the translation."""


_Point = tuple[tuple[float, ...], tuple[int, ...]]
"""Position and color."""


def find_model(folder: Path) -> Path | None:
    """Return the folder that holds a model's cameras and images, the first of the usual ones; None without any."""
    return next((folder / place for place in PLACES if _suffix(folder / place) is not None), None)


def _suffix(model: Path) -> str | None:
    """Return the ending of a model's files, binary where both forms are there; None without cameras and images."""
    both = ("cameras", "images")
    return next((end for end in (".bin", ".txt") if all((model / f"{name}{end}").is_file() for name in both)), None)


def read_colmap(model: Path, images: Path) -> Shots:
    """Read the model's shots, whose image files lie in `images`; binary where both forms are there.

    Raises CaptureError for a truncated or malformed file, a camera that an image names and the model lacks, and
    camera models without a pinhole behind OpenCV's distortion.
    """
    suffix = _suffix(model) or ".txt"
    cameras_file, file = model / f"cameras{suffix}", model / f"images{suffix}"
    cameras, records = read_cameras(cameras_file), _read_images(file)
    refuse_many(len(records), file)
    lenses = {each.number: _lens(each, Location(cameras_file, item=f"camera {each.number}")) for each in cameras}
    return Shots(model, tuple(_shot(record, lenses, file, images) for record in records))


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the model's points [points, 3] and their colors [points, 3] in 8 bits; None where it has no points."""
    path = next((path for end in (".bin", ".txt") if (path := model / f"points3D{end}").is_file()), None)
    found = _read_points(path) if path else []
    if not found:
        return None
    points = np.array([point for point, _ in found], dtype=np.float64)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(finite.argmin())
        wanted, advice = "finite coordinates", "run the reconstruction again"
        raise CaptureError.expected(wanted, points[row].tolist(), file=path, row=row, advice=advice)
    return points, np.array([color for _, color in found], dtype=np.uint8)


def _lens(record: _Camera, where: Location) -> Lens:
    model = MODELS.get(record.model)
    if model is None:
        message = f"expected a camera model among {', '.join(MODELS)}, got {record.model}; {_UNDISTORT}"
        raise where.error(message, name=where.item, value=record.model)
    count = len(record.parameters)
    if count != model.parameters:
        message = f"expected {model.parameters} parameters of {record.model}, got {count}"
        raise where.error(message, name=where.item, value=count)
    cx, cy, *rest = record.parameters[model.focals :]
    distortion = [0.0] * (4 if model.fisheye else 5)
    for index, value in zip(model.coefficients, rest, strict=True):
        distortion[index] = value
    focal = (record.parameters[0], record.parameters[model.focals - 1])
    return Lens(focal, (cx, cy), record.width, record.height, tuple(distortion), model.fisheye, where)


def _shot(record: _Image, lenses: dict[int, Lens], file: Path, images: Path) -> Shot:
    lens, where = lenses.get(record.camera), Location(file, item=f"image {record.name}")
    if lens is None:
        known = f"expected a camera of the model ({', '.join(map(str, lenses))}), got camera {record.camera}"
        raise where.error(f"{known}; export all parts of the model together", name=record.name, value=record.camera)
    values = np.array(record.pose)
    if not np.isfinite(values).all() or np.linalg.norm(values[:4]) < 1e-6:
        message = f"expected a rotation's quaternion and a translation, got {record.pose}; run the mapper again"
        raise where.error(message, name=record.name, value=record.pose)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix()
    pose[:3, 3] = values[4:]
    name = record.name.replace("\\", "/")
    return Shot(name, images / name, torch.from_numpy(pose), lambda _width, _height: lens)


class _Reader:
    """The bytes of a binary file, little-endian and packed, taken from the front."""

    def __init__(self, path: Path) -> None:
        self.path, self.place = path, 0
        try:
            self.content = path.read_bytes()
        except OSError as error:
            raise _unreadable(path, error) from error

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, laid out as `struct` says."""
        try:
            values = struct.unpack_from("<" + layout, self.content, self.place)
        except struct.error as error:
            raise self._short() from error
        self.place += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """Return the next text, up to a zero byte."""
        start, end = self.place, self.content.find(b"\0", self.place)
        if end < 0:
            raise self._short()
        self.place = end + 1
        return self.content[start:end].decode("utf-8", errors="replace")

    def _short(self) -> CaptureError:
        size = len(self.content)
        got = f"one that ends after {size} bytes inside a record"
        return CaptureError.expected(
            "a complete binary COLMAP file", size, got=got, file=self.path, advice="copy it again"
        )


def read_cameras(path: Path) -> list[_Camera]:
    """Read cameras.txt or cameras.bin.

    Raises CaptureError where it cannot be read, with the line that is malformed, and for an unknown camera model.
    """
    if path.suffix == ".txt":
        return [_parsed(path, row, line, _camera) for row, line in _lines(path) if line]
    reader, records = _Reader(path), []
    for _ in range(*reader.take("Q")):
        number, model, width, height = reader.take("IiQQ")
        if model not in _BINARY_MODELS:
            where, message = Location(path, item=f"camera {number}"), "expected a known camera model, got number"
            raise where.error(f"{message} {model}; {_UNDISTORT}", name=where.item, value=model)
        name, parameters = _BINARY_MODELS[model]
        records.append(_Camera(number, name, width, height, reader.take(f"{parameters}d")))
    return records


def _read_images(path: Path) -> list[_Image]:
    records = []
    if path.suffix == ".bin":
        reader = _Reader(path)
        for _ in range(*reader.take("Q")):
            _, *pose, camera = reader.take("I7dI")
            records.append(_Image(reader.text(), camera, tuple(pose)))
            reader.take(f"{24 * reader.take('Q')[0]}x")
        return records
    # Two rows an image.
    features_next = False
    for row, line in _lines(path):
        if features_next:
            _parsed(path, row, line, _features)
        elif line:
            records.append(_parsed(path, row, line, _image))
        features_next = bool(line) and not features_next
    return records


def _read_points(path: Path) -> list[_Point]:
    if path.suffix == ".txt":
        return [_parsed(path, row, line, _point) for row, line in _lines(path) if line]
    reader, points = _Reader(path), list[_Point]()
    for _ in range(*reader.take("Q")):
        _, x, y, z, red, green, blue, _, track = reader.take("Q3d3BdQ")
        points.append(((x, y, z), (red, green, blue)))
        reader.take(f"{8 * track}x")
    return points


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines that are no comments, with their numbers from 1."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from error
    for row, line in enumerate(text.splitlines(), start=1):
        if not line.strip().startswith("#"):
            yield row, line.strip()


def _unreadable(path: Path, error: OSError | UnicodeDecodeError) -> CaptureError:
    reason = getattr(error, "strerror", None) or str(error)
    advice = "get read permission, or export the model again"
    return CaptureError.expected("a readable file", reason, file=path, advice=advice)


def _parsed(path: Path, row: int, line: str, parse: Callable[[str], _Row]) -> _Row:
    try:
        return parse(line)
    except (ValueError, IndexError, OverflowError) as error:
        wanted = "a row as COLMAP writes it"
        raise CaptureError.expected(
            wanted, line, got=repr(line[:80]), file=path, row=row, advice="export the model again"
        ) from error


def _camera(line: str) -> _Camera:
    number, model, width, height, *parameters = line.split()
    return _Camera(int(number), model, int(width), int(height), tuple(map(float, parameters)))


def _image(line: str) -> _Image:
    # The name comes last and may hold blanks.
    _, *pose, camera, name = line.split(maxsplit=9)
    return _Image(name, int(camera), tuple(map(float, pose)))


def _features(line: str) -> None:
    """Refuse what is no list of features, so that no image is taken for one; the features themselves go unused."""
    values = line.split()
    if len(values) % 3:
        raise ValueError(line)
    for value in values[:3]:
        float(value)


def _point(line: str) -> _Point:
    _, x, y, z, red, green, blue, *_ = line.split()
    color = (int(red), int(green), int(blue))
    if not all(0 <= value <= 255 for value in color):
        raise ValueError(color)
    return (float(x), float(y), float(z)), color
