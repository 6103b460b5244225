"""COLMAP's text files: one row a camera and a point, two rows an image; lines that start with # are comments."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float, UInt8

from avmsf.capture.location import Location
from avmsf.errors import CaptureError
from avmsf.photographs.colmap_records import CameraRecord, ImageRecord

_Row = TypeVar("_Row")


def read_cameras(path: Path) -> list[CameraRecord]:
    """Read cameras.txt; raises CaptureError with the line that is malformed."""
    return [_parsed(path, row, line, _camera) for row, line in _lines(path) if line]


def read_images(path: Path) -> list[ImageRecord]:
    """Read images.txt; raises CaptureError with the line that is malformed."""
    records, features_next = [], False
    for row, line in _lines(path):
        if features_next:
            _parsed(path, row, line, _features)
            features_next = False
        elif line:
            records.append(_parsed(path, row, line, _image))
            features_next = True
    return records


def read_points(path: Path) -> tuple[Float[np.ndarray, "points 3"], UInt8[np.ndarray, "points 3"]]:
    """Read positions and colors from points3D.txt; raises CaptureError with the line that is malformed."""
    points = [_parsed(path, row, line, _point) for row, line in _lines(path) if line]
    places = np.array([place for place, _ in points], dtype=np.float64).reshape(-1, 3)
    return places, np.array([color for _, color in points], dtype=np.uint8).reshape(-1, 3)


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


def _camera(line: str) -> CameraRecord:
    number, model, width, height, *parameters = line.split()
    return CameraRecord(int(number), model, int(width), int(height), tuple(map(float, parameters)))


def _image(line: str) -> ImageRecord:
    # The name comes last and may hold blanks.
    _, w, x, y, z, right, down, ahead, camera, name = line.split(maxsplit=9)
    quaternion = (float(w), float(x), float(y), float(z))
    return ImageRecord(name, int(camera), quaternion, (float(right), float(down), float(ahead)))


def _features(line: str) -> None:
    """Refuse what is no list of features, so that no image is taken for one; the features themselves go unused."""
    values = line.split()
    if len(values) % 3:
        raise ValueError(line)
    for value in values[:3]:
        float(value)


def _point(line: str) -> tuple[tuple[float, float, float], tuple[int, int, int]]:
    _, x, y, z, red, green, blue, *_ = line.split()
    color = (int(red), int(green), int(blue))
    if not all(0 <= value <= 255 for value in color):
        raise ValueError(color)
    return (float(x), float(y), float(z)), color
