"""COLMAP's sparse models: cameras, images and points, in text or binary, whichever lies in the folder."""

import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avmsf.errors import CaptureError
from avmsf.photographs.lenses import Lens, Location
from avmsf.photographs.photograph import CameraFile, Photograph, check_count

PLACES = ("sparse/0", "sparse", ".")
_Record = TypeVar("_Record")
_Image = tuple[str, int, list[float]]
"""Name, number of the camera, and the rotation of the world into it (a quaternion w, x, y, z) with the translation."""
_Point = tuple[tuple[float, float, float], tuple[int, int, int]]
"""Position and color."""


class CameraModel(NamedTuple):
    """How a camera model's parameters are laid out: focal lengths, then cx cy, then coefficients."""

    focals: int
    coefficients: int = 0
    """How many of k1 k2 p1 p2 of a perspective lens, or of k1 k2 k3 k4 of a fisheye."""
    fisheye: bool = False


MODELS = {
    "SIMPLE_PINHOLE": CameraModel(1),
    "PINHOLE": CameraModel(2),
    "SIMPLE_RADIAL": CameraModel(1, 1),
    "RADIAL": CameraModel(1, 2),
    "OPENCV": CameraModel(2, 4),
    "OPENCV_FISHEYE": CameraModel(2, 4, fisheye=True),
    "SIMPLE_RADIAL_FISHEYE": CameraModel(1, 1, fisheye=True),
    "RADIAL_FISHEYE": CameraModel(1, 2, fisheye=True),
}
_OTHERS = {6: "FULL_OPENCV", 7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE"}
_BINARY_MODELS = dict(zip((0, 1, 2, 3, 4, 5, 8, 9), MODELS, strict=True)) | _OTHERS
"""Names by COLMAP's numbers in binary files, also of models that are refused."""


def find_model(folder: Path) -> Path | None:
    """Return the folder that holds a model's cameras and images, the first of the usual ones; None without any."""
    return next((folder / place for place in PLACES if _parts(folder / place, "cameras", "images")), None)


def read_colmap(model: Path, folder: Path) -> CameraFile:
    """Read a model of the photographs in a folder's `images/`, or itself; binary where both forms are there.

    Raises CaptureError for a truncated or malformed file, a camera that an image names and the model lacks, and
    camera models without a pinhole behind OpenCV's distortion.
    """
    cameras, images = _parts(model, "cameras", "images")
    lenses, records, photographs = read_lenses(cameras), _read_images(images), []
    check_count(len(records), images)
    source = folder / "images" if (folder / "images").is_dir() else folder
    for name, camera, pose in records:
        lens, where = lenses.get(camera), Location(images, item=f"image {name}")
        if lens is None:
            wanted, advice = f"a camera among {', '.join(map(str, lenses))}", "export all parts of the model together"
            raise where.expected(wanted, camera, name=name, advice=advice)
        path, world_to_camera = name.replace("\\", "/"), _world_to_camera(pose, name, where)
        photographs.append(Photograph(path, source / path, world_to_camera, lambda *_, lens=lens: lens))
    return CameraFile(model, folder, tuple(photographs))


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the model's points [points, 3] and their colors [points, 3] in 8 bits; None where it has no points."""
    parts = _parts(model, "points3D")
    found = _read_points(parts[0]) if parts else []
    if not found:
        return None
    points = np.array([point for point, _ in found], dtype=np.float64)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(finite.argmin())
        wanted, advice = "finite coordinates", "run the reconstruction again"
        raise CaptureError.expected(wanted, points[row].tolist(), file=parts[0], row=row, advice=advice)
    return points, np.array([color for _, color in found], dtype=np.uint8)


def read_lenses(path: Path) -> dict[int, Lens]:
    """Return the lenses of cameras.txt or cameras.bin by the cameras' numbers.

    Raises CaptureError where it cannot be read, with the line that is malformed, and for other camera models.
    """
    if path.suffix == ".txt":
        cameras = _parse_lines(path, _camera)
        return {number: _lens(path, number, name, size, values) for number, name, size, values in cameras}
    reader, lenses = _Reader(path), {}
    for _ in range(*reader.take("Q")):
        number, model, width, height = reader.take("IiQQ")
        name = _BINARY_MODELS.get(model, model)
        focals, coefficients, _ = _model(path, number, name)
        lenses[number] = _lens(path, number, name, (width, height), reader.take(f"{focals + 2 + coefficients}d"))
    return lenses


def _parts(model: Path, *names: str) -> list[Path]:
    """Return the files of a model, binary where both forms are there; none unless all of them are there."""
    forms = ([model / f"{name}{suffix}" for name in names] for suffix in (".bin", ".txt"))
    return next((files for files in forms if all(file.is_file() for file in files)), [])


def _model(path: Path, number: int, name: str | int) -> CameraModel:
    if name not in MODELS:
        where, wanted = Location(path, item=f"camera {number}"), f"a camera model among {', '.join(MODELS)}"
        advice = "undistort the images first (colmap image_undistorter)"
        raise where.expected(wanted, name, name=where.item, advice=advice)
    return MODELS[str(name)]


def _lens(path: Path, number: int, name: str, size: tuple[int, int], parameters: Sequence[float]) -> Lens:
    (focals, count, fisheye), where = _model(path, number, name), Location(path, item=f"camera {number}")
    if len(parameters) != focals + 2 + count:
        raise where.expected(f"{focals + 2 + count} parameters of {name}", len(parameters), name=where.item)
    cx, cy, *coefficients = parameters[focals:]
    distortion = (*coefficients, *[0.0] * ((4 if fisheye else 5) - count))
    return Lens((parameters[0], parameters[focals - 1]), (cx, cy), *size, distortion, fisheye, where)


def _world_to_camera(pose: Sequence[float], name: str, where: Location) -> torch.Tensor:
    """Return the pose of a quaternion w, x, y, z of any length and a translation."""
    values = np.array(pose)
    if not np.isfinite(values).all() or np.linalg.norm(values[:4]) < 1e-6:
        wanted, advice = "a rotation's quaternion and a translation", "run the mapper again"
        raise where.expected(wanted, pose, name=name, advice=advice)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix()
    matrix[:3, 3] = values[4:]
    return torch.from_numpy(matrix)


def _read_images(path: Path) -> list[_Image]:
    images = []
    if path.suffix == ".bin":
        reader = _Reader(path)
        for _ in range(*reader.take("Q")):
            _, *pose, camera = reader.take("I7dI")
            images.append((reader.text(), camera, pose))
            reader.take(f"{24 * reader.take('Q')[0]}x")
        return images
    # A line of features, often an empty one, follows each image's.
    features_next = False
    for row, line in _lines(path):
        if features_next:
            _parse(path, row, line, _features)
        elif line:
            images.append(_parse(path, row, line, _image))
        features_next = bool(line) and not features_next
    return images


def _read_points(path: Path) -> list[_Point]:
    if path.suffix == ".txt":
        return _parse_lines(path, _point)
    reader, points = _Reader(path), []
    for _ in range(*reader.take("Q")):
        _, x, y, z, red, green, blue, _, track = reader.take("Q3d3BdQ")
        points.append(((x, y, z), (red, green, blue)))
        reader.take(f"{8 * track}x")
    return points


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
        size, wanted = len(self.content), "a complete binary COLMAP file"
        got = f"one that ends after {size} bytes inside a record"
        return CaptureError.expected(wanted, size, got=got, file=self.path, advice="copy it again")


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


def _parse_lines(path: Path, parse: Callable[[str], _Record]) -> list[_Record]:
    return [_parse(path, row, line, parse) for row, line in _lines(path) if line]


def _parse(path: Path, row: int, line: str, parse: Callable[[str], _Record]) -> _Record:
    try:
        return parse(line)
    except (ValueError, IndexError, OverflowError) as error:
        wanted, got, advice = "a row as COLMAP writes it", repr(line[:80]), "export the model again"
        raise CaptureError.expected(wanted, line, got=got, file=path, row=row, advice=advice) from error


def _camera(line: str) -> tuple[int, str, tuple[int, int], list[float]]:
    number, model, width, height, *parameters = line.split()
    return int(number), model, (int(width), int(height)), list(map(float, parameters))


def _image(line: str) -> _Image:
    # The name comes last and may hold blanks.
    _, w, x, y, z, right, down, ahead, camera, name = line.split(maxsplit=9)
    if "\0" in name:
        raise ValueError(name)
    return name, int(camera), list(map(float, (w, x, y, z, right, down, ahead)))


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
