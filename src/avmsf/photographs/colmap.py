"""COLMAP's sparse models: cameras, images and points, in text or binary, whichever lies in the folder."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avmsf.errors import CaptureError
from avmsf.photographs.lenses import CameraFile, Lens, Location, Photograph

PLACES = ("sparse/0", "sparse", ".")
MODELS = {
    "SIMPLE_PINHOLE": (1, 0),
    "PINHOLE": (2, 0),
    "SIMPLE_RADIAL": (1, 1),
    "RADIAL": (1, 2),
    "OPENCV": (2, 4),
    "OPENCV_FISHEYE": (2, 4),
    "SIMPLE_RADIAL_FISHEYE": (1, 1),
    "RADIAL_FISHEYE": (1, 2),
}
"""How many focal lengths and coefficients, of k1 k2 p1 p2 or of a fisheye's k1 k2 k3 k4, a camera model has.

Its parameters are the focal lengths, cx, cy, and the coefficients."""
_OTHERS = {6: "FULL_OPENCV", 7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE"}
_BINARY_MODELS = dict(zip((0, 1, 2, 3, 4, 5, 8, 9), MODELS, strict=True)) | _OTHERS
"""Names by COLMAP's numbers in binary files, also of models that are not read."""


def find_model(folder: Path) -> Path | None:
    """Return the folder that holds a model's cameras and images, the first of the usual ones; None without any."""
    return next((folder / place for place in PLACES if _parts(folder / place, "cameras", "images")), None)


def read_colmap(model: Path, folder: Path) -> CameraFile:
    """Read a model of the photographs in a folder's `images/`, or itself; binary where both forms are there.

    Raises CaptureError for a truncated or malformed file, a camera that an image names and the model lacks, and
    camera models without a pinhole behind OpenCV's distortion.
    """
    cameras, images = _parts(model, "cameras", "images")
    lenses, photographs = read_lenses(cameras), []
    source = folder / "images" if (folder / "images").is_dir() else folder
    for name, camera, pose in _images(images):
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
    found = list(_points(parts[0])) if parts else []
    if not found:
        return None
    points = np.array([record[:3] for record in found], dtype=np.float64)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        row = int(finite.argmin())
        wanted, advice = "finite coordinates", "run the reconstruction again"
        raise CaptureError.expected(wanted, points[row].tolist(), file=parts[0], row=row, advice=advice)
    return points, np.array([record[3:] for record in found], dtype=np.uint8)


def read_lenses(path: Path) -> dict[int, Lens]:
    """Return the lenses of cameras.txt or cameras.bin by the cameras' numbers.

    Raises CaptureError where it cannot be read, with the line that is malformed, and for other camera models.
    """
    lenses = {}
    for number, name, size, parameters in _cameras(path):
        where = Location(path, item=f"camera {number}")
        if name not in MODELS:
            wanted = f"a camera model among {', '.join(MODELS)}"
            advice = "undistort the images first (colmap image_undistorter)"
            raise where.expected(wanted, name, name=where.item, advice=advice)
        focals, count = MODELS[name]
        if len(parameters) != focals + 2 + count:
            raise where.expected(f"{focals + 2 + count} parameters of {name}", len(parameters), name=where.item)
        (cx, cy, *coefficients), fisheye = parameters[focals:], "FISHEYE" in name
        distortion = (*coefficients, *[0.0] * ((4 if fisheye else 5) - count))
        lenses[number] = Lens((parameters[0], parameters[focals - 1]), (cx, cy), *size, distortion, fisheye, where)
    return lenses


def _parts(model: Path, *names: str) -> list[Path]:
    """Return the files of a model, binary where both forms are there; none unless all of them are there."""
    forms = ([model / f"{name}{suffix}" for name in names] for suffix in (".bin", ".txt"))
    return next((files for files in forms if all(file.is_file() for file in files)), [])


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


def _cameras(path: Path) -> Iterator[tuple[int, Any, tuple[int, int], Sequence[float]]]:
    """Yield each camera's number, model, width and height, and parameters, which an unknown model has none of."""
    if path.suffix == ".txt":
        for row, line in _lines(path):
            with _reading(path, row, line):
                number, name, width, height, *values = line.split()
                camera = int(number), name, (int(width), int(height)), list(map(float, values))
            yield camera
        return
    reader = _Reader(path)
    for _ in range(*reader.take("Q")):
        number, model, width, height = reader.take("IiQQ")
        name = _BINARY_MODELS.get(model, model)
        count = sum(MODELS[name]) + 2 if name in MODELS else 0
        yield number, name, (width, height), reader.take(f"{count}d")


def _images(path: Path) -> Iterator[tuple[str, int, Sequence[float]]]:
    """Yield each image's name, its camera's number, and the quaternion w, x, y, z and translation of its pose."""
    if path.suffix == ".bin":
        reader = _Reader(path)
        for _ in range(*reader.take("Q")):
            _, *pose, camera = reader.take("I7dI")
            name = reader.text()
            reader.take(f"{24 * reader.take('Q')[0]}x")
            yield name, camera, pose
        return
    features_next = False
    for row, line in _lines(path, blank=True):
        with _reading(path, row, line):
            if features_next:
                # They go unused, and are checked so that no image is taken for them; often there are none.
                features = line.split()
                list(map(float, features[:3]))
                if len(features) % 3:
                    raise ValueError(line)
            elif line:
                # The name comes last and may hold blanks.
                _, w, x, y, z, right, down, ahead, camera, name = line.split(maxsplit=9)
                if "\0" in name:
                    raise ValueError(name)
                image = name, int(camera), list(map(float, (w, x, y, z, right, down, ahead)))
        features_next = bool(line) and not features_next
        if features_next:
            yield image


def _points(path: Path) -> Iterator[tuple[float, ...]]:
    """Yield each point's x, y, z and its red, green, blue."""
    if path.suffix == ".txt":
        for row, line in _lines(path):
            with _reading(path, row, line):
                _, x, y, z, *color = line.split()[:7]
                red, green, blue = map(int, color)
                if not 0 <= min(red, green, blue) <= max(red, green, blue) <= 255:
                    raise ValueError(color)
                point = float(x), float(y), float(z), red, green, blue
            yield point
        return
    reader = _Reader(path)
    for _ in range(*reader.take("Q")):
        _, *values, _, track = reader.take("Q3d3BdQ")
        reader.take(f"{8 * track}x")
        yield tuple(values)


class _Reader:
    """The bytes of a binary file, little-endian and packed, taken from the front."""

    def __init__(self, path: Path) -> None:
        self.path, self.place = path, 0
        with _reading(path):
            self.content = path.read_bytes()

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, laid out as `struct` says."""
        try:
            values = struct.unpack_from("<" + layout, self.content, self.place)
        except struct.error as error:
            size, wanted = len(self.content), "a complete binary COLMAP file"
            got = f"one that ends after {size} bytes inside a record"
            raise CaptureError.expected(wanted, size, got=got, file=self.path, advice="copy it again") from error
        self.place += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """Return the next text, up to a zero byte."""
        end = self.content.find(b"\0", self.place)
        (text,) = self.take(f"{(end if end >= 0 else len(self.content)) - self.place}sx")
        return text.decode("utf-8", errors="replace")


def _lines(path: Path, *, blank: bool = False) -> Iterator[tuple[int, str]]:
    """Yield the lines that are no comments, and only with `blank` those that are empty, with their numbers from 1."""
    with _reading(path):
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    for row, line in enumerate(map(str.strip, lines), start=1):
        if not line.startswith("#") and (line or blank):
            yield row, line


@contextmanager
def _reading(path: Path, row: int | None = None, line: str | None = None) -> Iterator[None]:
    """Raise CaptureError where the file, or a line of it, cannot be read."""
    try:
        yield
    except (OSError, ValueError, OverflowError) as error:
        value = line or getattr(error, "strerror", None) or str(error)
        wanted, advice = "a row as COLMAP writes it", "export the model again"
        if row is None:
            wanted, advice = "a readable file", f"get read permission, or {advice}"
        raise CaptureError.expected(wanted, value, got=repr(value[:80]), file=path, row=row, advice=advice) from error
