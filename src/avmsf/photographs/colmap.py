"""COLMAP's sparse models: cameras, images and points, in text or binary, whichever lies in the folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from avmsf.capture.location import Location
from avmsf.photographs import colmap_binary, colmap_text
from avmsf.photographs.colmap_records import CameraRecord, ImageRecord
from avmsf.photographs.lenses import Lens
from avmsf.photographs.shots import Shot, Shots, refuse_many

PLACES = ("sparse/0", "sparse", ".")


@dataclass(frozen=True)
class _Model:
    """How a camera model's parameters are laid out: focal lengths, then cx cy, then these coefficients."""

    focals: int
    coefficients: tuple[int, ...]
    """Where each parameter after cx cy goes: 0-3 in k1 k2 p1 p2 of a perspective lens, in k1 k2 k3 k4 of a fisheye."""
    fisheye: bool = False

    @property
    def parameters(self) -> int:
        return self.focals + 2 + len(self.coefficients)


MODELS = {
    "SIMPLE_PINHOLE": _Model(1, ()),
    "PINHOLE": _Model(2, ()),
    "SIMPLE_RADIAL": _Model(1, (0,)),
    "RADIAL": _Model(1, (0, 1)),
    "OPENCV": _Model(2, (0, 1, 2, 3)),
    "OPENCV_FISHEYE": _Model(2, (0, 1, 2, 3), fisheye=True),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, (0,), fisheye=True),
    "RADIAL_FISHEYE": _Model(1, (0, 1), fisheye=True),
}


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
    binary = (model / "cameras.bin").is_file() and (model / "images.bin").is_file()
    suffix, reader = (".bin", colmap_binary) if binary else (".txt", colmap_text)
    cameras_file, images_file = model / f"cameras{suffix}", model / f"images{suffix}"
    lenses = {
        record.number: _lens(record, Location(cameras_file, item=f"camera {record.number}"))
        for record in reader.read_cameras(cameras_file)
    }
    records = reader.read_images(images_file)
    refuse_many(len(records), images_file)
    shots = [_shot(record, lenses, images_file, images) for record in records]
    return Shots(model, tuple(shots))


def read_points(model: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the model's points [points, 3] and their colors [points, 3] in 8 bits; None where it has no points."""
    for suffix, reader in ((".bin", colmap_binary), (".txt", colmap_text)):
        path = model / f"points3D{suffix}"
        if path.is_file():
            points, colors = reader.read_points(path)
            if not np.isfinite(points).all():
                row = int(np.isfinite(points).all(axis=1).argmin())
                raise Location(path, row, f"point {row}").error(
                    f"expected finite coordinates, got {points[row].tolist()}; run the reconstruction again",
                    value=points[row].tolist(),
                )
            return (points, colors) if len(points) else None
    return None


def _lens(record: CameraRecord, where: Location) -> Lens:
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
    focals, center, rest = model.focals, model.focals + 2, record.parameters[model.focals + 2 :]
    distortion = [0.0] * (4 if model.fisheye else 5)
    for place, value in zip(model.coefficients, rest, strict=True):
        distortion[place] = value
    cx, cy = record.parameters[focals:center]
    focal = (record.parameters[0], record.parameters[focals - 1])
    return Lens(focal, (cx, cy), record.width, record.height, tuple(distortion), model.fisheye, where)


def _shot(record: ImageRecord, lenses: dict[int, Lens], file: Path, images: Path) -> Shot:
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

    def lens_of(_width: int, _height: int) -> Lens:
        return lens

    name = record.name.replace("\\", "/")
    return Shot(name, images / name, pose, lens_of)


def _rotation(record: ImageRecord, where: Location) -> np.ndarray:
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
