"""Rows of a COLMAP model, the same from text and binary."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraRecord:
    """One camera."""

    number: int
    model: str
    """COLMAP's name of the camera model, or its number where this has no name here."""
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class ImageRecord:
    """One registered image: the rigid transform of the world into its camera."""

    name: str
    camera: int
    quaternion: tuple[float, float, float, float]
    """w, x, y, z."""
    translation: tuple[float, float, float]
