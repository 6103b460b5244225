"""What camera files say of photographs: lenses, whose distortion is removed here, and poses."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avmsf.capture.filenames import pictures_in
from avmsf.errors import CaptureError
from avmsf.photographs.cameras import Camera
from avmsf.photographs.images import MAX_PIXELS

_GRID_POINTS = 33
"""Points along each side of a pinhole's image at which a lens is tested."""


@dataclass(frozen=True)
class Location:
    """A file, one item in it, or an item alone."""

    file: Path | str | None
    row: int | None = None
    """Line of a table from 1, or index in a list from 0."""
    item: str = ""
    """What messages call it: "row 3", "frame 0", "image left.png"."""

    def __str__(self) -> str:
        return ", ".join(str(part) for part in (self.file, self.item) if part)

    def expected(
        self, wanted: str, value: Any = None, *, name: str, got: str | None = None, advice: str = ""
    ) -> CaptureError:
        """Return an error about what is there, as `CaptureError.expected` does."""
        message = str(CaptureError.expected(wanted, value, got=got, name=str(self), advice=advice))
        return CaptureError(message, file=self.file, row=self.row, name=name, value=value)


_ANY_CAMERA = Location(None, item="the camera")


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics with distortion, for images of one size; pixels as in `Camera`: centers half a pixel from the edges.

    With x, y the point's position at depth one and r its distance from the axis, the perspective lens moves it to
    x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²) and likewise in y; the fisheye lens moves it along its
    radius from r to θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), θ = arctan r. These are OpenCV's and COLMAP's models.
    """

    focal: tuple[float, float]
    """Along x and y, pixels."""
    principal: tuple[float, float]
    """Pixels."""
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    distortion: tuple[float, ...] = ()
    """k1 k2 p1 p2 k3 of a perspective lens, k1 k2 k3 k4 of a fisheye; empty for a perspective lens without any."""
    fisheye: bool = False
    origin: Location = _ANY_CAMERA
    """Where it was read, for errors."""

    def __post_init__(self) -> None:
        numbers = [*self.focal, *self.principal, *self.distortion]
        sized = 1 <= min(self.width, self.height) <= max(self.width, self.height) <= MAX_PIXELS
        if not (sized and all(map(math.isfinite, numbers)) and min(self.focal) > 0):
            size = f"size {self.width} x {self.height}"
            got = f"focal {self.focal}, principal point {self.principal}, distortion {self.distortion}, {size}"
            wanted, advice = "finite intrinsics, positive focal lengths and a size", "calibrate this camera again"
            values = [*numbers, self.width, self.height]
            raise self.origin.expected(wanted, values, got=got, name="intrinsics", advice=advice)

    @property
    def pinhole(self) -> Camera:
        """The camera with these intrinsics at the origin, without the distortion."""
        return Camera(torch.eye(4, dtype=torch.float64), self.focal, self.principal, self.width, self.height)

    def resized(self, width: int, height: int) -> "Lens":
        """Return the lens of the same image with another number of pixels."""
        same = self.pinhole.resized(width, height)
        return replace(self, focal=same.focal, principal=same.principal, width=width, height=height)


def undistort(
    pixels: UInt8[np.ndarray, "height width channels"], lens: Lens
) -> tuple[UInt8[np.ndarray, "height width channels"], Camera]:
    """Return an image, mask included, as a pinhole at the origin would have taken it, and that pinhole.

    It has the size and the principal point of the original. Its focal length is the smallest at which every pixel
    still shows something, so that nothing black is made up at the edges: a part of the outermost pixels may be lost,
    and a fisheye keeps at most what twice the width and height of its middle take in. Interpolation is bilinear.
    Raises CaptureError where the distortion folds the image over, as coefficients of another model do.
    """
    if not lens.fisheye and not any(lens.distortion):
        return pixels, lens.pinhole
    pinhole = _widest_pinhole(lens)
    across, down = _sources(lens, pinhole, (pinhole.width, pinhole.height))
    return cv2.remap(pixels, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), pinhole


def _widest_pinhole(lens: Lens) -> Camera:
    """Return the pinhole of smallest focal length, by bisection, whose every pixel lies in the lens's image."""
    # No wider than twice the width and height of the lens's middle.
    narrow, wide = 4.0, 0.5
    if not _covers(lens, narrow):
        advice = f"check the camera model (fisheye: {lens.fisheye}) and the order of its coefficients"
        raise lens.origin.expected("an invertible distortion", lens.distortion, name="distortion", advice=advice)
    if _covers(lens, wide):
        narrow = wide
    while narrow / wide > 1 + 1e-5:
        middle = math.sqrt(narrow * wide)
        narrow, wide = (middle, wide) if _covers(lens, middle) else (narrow, middle)
    return _pinhole(lens, narrow)


def _pinhole(lens: Lens, zoom: float) -> Camera:
    return replace(lens.pinhole, focal=(lens.focal[0] * zoom, lens.focal[1] * zoom))


def _covers(lens: Lens, zoom: float) -> bool:
    """Whether a pinhole with `zoom` times the focal length sees only what the lens sees, and sees it unfolded."""
    # One step more on each side than the image has, so that slopes are central differences up to its corners.
    steps = (max(lens.width - 1, 1) / (_GRID_POINTS - 1), max(lens.height - 1, 1) / (_GRID_POINTS - 1))
    across, down = _sources(lens, _pinhole(lens, zoom), (_GRID_POINTS + 2, _GRID_POINTS + 2), steps=steps, margin=1)
    (across_y, across_x), (down_y, down_x) = np.gradient(across), np.gradient(down)
    unfolded = across_x * down_y - across_y * down_x > 0
    inside = (across >= -1e-3) & (across <= lens.width - 1 + 1e-3) & (down >= -1e-3) & (down <= lens.height - 1 + 1e-3)
    return bool((inside & unfolded)[1:-1, 1:-1].all())


def _sources(
    lens: Lens, pinhole: Camera, size: tuple[int, int], *, steps: tuple[float, float] = (1.0, 1.0), margin: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return where in the lens's image the pinhole's pixels come from.

    `size` of them, each `steps` pixels from the next, from `margin` steps before the first pixel.
    """
    # OpenCV puts pixel centers at whole numbers: half a pixel off both principal points.
    old, new = np.eye(3), np.eye(3)
    old[0, 0], old[1, 1] = lens.focal
    old[0, 2], old[1, 2] = lens.principal[0] - 0.5, lens.principal[1] - 0.5
    for axis in range(2):
        new[axis, axis] = pinhole.focal[axis] / steps[axis]
        new[axis, 2] = (pinhole.principal[axis] - 0.5) / steps[axis] + margin
    coefficients = np.array(lens.distortion or (0.0, 0.0, 0.0, 0.0), dtype=np.float64)
    maps = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    across, down = maps(old, coefficients, np.eye(3), new, size, cv2.CV_32FC1)
    return across, down


@dataclass(frozen=True, eq=False)
class Photograph:
    """An image file with the camera that took it."""

    name: str
    """Its path below `images/`, with forward slashes: its name in messages and for masks."""
    image: Path
    world_to_camera: Float[Tensor, "4 4"]
    """Rigid, OpenCV's axes; in the file's unit of length."""
    lens_of: Callable[[int, int], Lens]
    """The lens, given the image's width and height, which are used only where the camera file has no size."""
    mask: Path | None = None
    """The mask that the file names for it."""


@dataclass(frozen=True, eq=False)
class CameraFile:
    """All that a camera file names."""

    path: Path
    """The file, or the folder that holds its parts."""
    folder: Path
    """Where `images/` and `masks/` are."""
    photographs: tuple[Photograph, ...]
    scaled: tuple[str, ...] = ()
    """Names of photographs of which a scale was removed from the pose's rotation, with the scale."""

    def without_camera(self) -> list[str]:
        """Return the names of image files that lie among the photographs but have no camera."""
        known = {path.resolve() for each in self.photographs for path in (each.image, each.mask) if path is not None}
        images = self.folder / "images"
        if images.is_dir():
            found = {path: path.relative_to(images).as_posix() for path in pictures_in(images, deep=True)}
        else:
            parents = {each.image.parent for each in self.photographs}
            found = {path: path.name for parent in parents for path in pictures_in(parent, deep=False)}
        return sorted(name for path, name in found.items() if path.resolve() not in known)
