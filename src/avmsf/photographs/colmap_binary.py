"""COLMAP's binary files: little-endian, packed, each led by its number of rows."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from avmsf.capture.location import Location
from avmsf.errors import CaptureError
from avmsf.photographs.colmap_records import CameraRecord, ImageRecord

# By COLMAP's number: name and how many parameters follow, also of models that are then refused by name.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}


class _Reader:
    """A file's bytes, taken from the front."""

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


def read_cameras(path: Path) -> list[CameraRecord]:
    """Read cameras.bin; raises CaptureError where it is truncated or names an unknown camera model."""
    reader, records = _Reader(path), []
    (count,) = reader.take("Q")
    for _ in range(count):
        number, model, width, height = reader.take("IiQQ")
        if model not in _MODELS:
            raise Location(path, item=f"camera {number}").error(
                f"expected a known camera model, got number {model}; undistort the images first (colmap "
                "image_undistorter)",
                name=f"camera {number}",
                value=model,
            )
        name, parameters = _MODELS[model]
        records.append(CameraRecord(number, name, width, height, reader.take(f"{parameters}d")))
    return records


def read_images(path: Path) -> list[ImageRecord]:
    """Read images.bin; raises CaptureError where it is truncated."""
    reader, records = _Reader(path), []
    (count,) = reader.take("Q")
    for _ in range(count):
        _, w, x, y, z, right, down, ahead, camera = reader.take("I7dI")
        name = reader.text()
        records.append(ImageRecord(name, camera, (w, x, y, z), (right, down, ahead)))
        (features,) = reader.take("Q")
        reader.skip(24 * features)
    return records


def read_points(path: Path) -> tuple[Float[np.ndarray, "points 3"], UInt8[np.ndarray, "points 3"]]:
    """Read places and colors from points3D.bin; raises CaptureError where it is truncated."""
    reader = _Reader(path)
    (count,) = reader.take("Q")
    places, colors = [], []
    for _ in range(count):
        _, x, y, z, red, green, blue, _, track = reader.take("Q3d3BdQ")
        reader.skip(8 * track)
        places.append((x, y, z))
        colors.append((red, green, blue))
    return np.array(places, dtype=np.float64).reshape(-1, 3), np.array(colors, dtype=np.uint8).reshape(-1, 3)
