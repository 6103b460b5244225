"""Photographs that a camera file names, each with its pose, lens and mask; and how one becomes a view."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import pictures_in
from avmsf.errors import CaptureError, Remark
from avmsf.photographs.cameras import View
from avmsf.photographs.images import UnreadableImageError, read_image, read_mask, scale, size_of
from avmsf.photographs.lenses import Lens, undistort

MAX_PHOTOGRAPHS = 10_000
"""Photographs of one object: a video of five minutes, frame by frame. Splatting uses some hundreds."""
Findings = defaultdict[str, list[str]]
"""Names of images, by the keys of `KINDS`."""
KINDS = {
    "transform_matrix": ("pose", "with a scaled rotation, whose scale was removed"),
    "cameras": ("image", "without a camera, not used"),
    "missing images": ("image", "missing or corrupt, not used"),
    "empty masks": ("image", "with an empty mask, not used"),
    "image sizes": ("image", "of another size than the camera, whose intrinsics were scaled"),
    "orientations": ("image", "rotated by the orientation tag to fit the camera"),
    "missing masks": ("mask", "missing or corrupt; the images are used without"),
    "mask sizes": ("mask", "scaled from another size to that of the image"),
}
"""Problems of single images, which are reported together: what they concern, and what became of it."""


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


def check_count(count: int, file: Path) -> None:
    """Raise CaptureError for more than `MAX_PHOTOGRAPHS` in a camera file."""
    if count > MAX_PHOTOGRAPHS:
        wanted, advice = f"at most {MAX_PHOTOGRAPHS:,} photographs", "select some hundreds"
        raise CaptureError.expected(wanted, count, file=file, name="photographs", advice=advice)


def mask_paths(name: str, folder: Path) -> list[Path]:
    """Return the paths where the mask of the photograph of this name may be, the likeliest first."""
    path = PurePosixPath(name)
    return [folder / "masks" / path.with_suffix(".png"), folder / "masks" / f"{path}.png"]


def summarize(findings: Mapping[str, Sequence[str]]) -> list[Remark]:
    """Return one remark for each kind of finding of `KINDS`; its value is the images."""
    return [
        Remark(f"{counted(len(findings[name]), thing)} {message}: {listed(findings[name])}", name, findings[name])
        for name, (thing, message) in KINDS.items()
        if findings.get(name)
    ]


def read_view(
    photograph: Photograph, folder: Path, longest: int | None, meters: float, findings: Findings
) -> View | None:
    """Read one photograph and its mask into a pinhole's view; None, and a finding, where there is nothing to see."""
    try:
        pixels = read_image(photograph.image)
    except UnreadableImageError:
        findings["missing images"].append(photograph.name)
        return None
    pixels, lens = _with_lens(photograph, pixels, findings)
    pixels, camera = undistort(_with_mask(photograph, folder, pixels, findings), lens)
    if longest is not None and max(size_of(pixels)) > longest:
        width, height = (max(1, round(side * longest / max(size_of(pixels)))) for side in size_of(pixels))
        pixels, camera = scale(pixels, width, height), camera.resized(width, height)
    mask = torch.from_numpy(np.ascontiguousarray(pixels[..., 3])) if pixels.shape[2] == 4 else None
    if mask is not None and not mask.any():
        findings["empty masks"].append(photograph.name)
        return None
    pose = photograph.world_to_camera.clone()
    pose[:3, 3] *= meters
    image = torch.from_numpy(np.ascontiguousarray(pixels[..., :3]))
    return View(photograph.name, image, replace(camera, world_to_camera=pose), mask)


def _with_lens(
    photograph: Photograph, pixels: UInt8[np.ndarray, "height width channels"], findings: Findings
) -> tuple[UInt8[np.ndarray, "height width channels"], Lens]:
    """Return image and lens of one size; raises CaptureError where their shapes differ."""
    lens = photograph.lens_of(*size_of(pixels))
    size = (lens.width, lens.height)
    if pixels.shape[2] == 3 and size_of(pixels) != size:
        upright = read_image(photograph.image, upright=True)
        if size_of(upright) != size_of(pixels) and _same_shape(size_of(upright), size):
            pixels = upright
            findings["orientations"].append(photograph.name)
    if size_of(pixels) == size:
        return pixels, lens
    if not _same_shape(size_of(pixels), size):
        advice = "give the images of which the cameras were estimated, not cropped or rotated"
        raise _shape_error(pixels, size, f"its camera's ({lens.origin})", photograph.image, "image", advice)
    findings["image sizes"].append(f"{photograph.name} ({_shown(size_of(pixels))} instead of {_shown(size)})")
    return pixels, lens.resized(*size_of(pixels))


def _with_mask(
    photograph: Photograph, folder: Path, pixels: UInt8[np.ndarray, "height width channels"], findings: Findings
) -> UInt8[np.ndarray, "height width masked_channels"]:
    """Return the image with the mask that lies in a file, where it has none of its own."""
    named = [] if photograph.mask is None else [photograph.mask]
    paths = [path for path in (*named, *mask_paths(photograph.name, folder)) if path.is_file()] or named
    if pixels.shape[2] == 4 or not paths:
        return pixels
    try:
        mask = read_mask(paths[0])
    except UnreadableImageError:
        findings["missing masks"].append(photograph.name)
        return pixels
    size = size_of(pixels)
    if not _same_shape(size_of(mask), size):
        raise _shape_error(mask, size, "its image's", paths[0], "mask", "make the mask of this image")
    if size_of(mask) != size:
        findings["mask sizes"].append(f"{photograph.name} ({_shown(size_of(mask))} for {_shown(size)})")
    return np.dstack([pixels, scale(mask, *size)])


def _shape_error(
    pixels: np.ndarray, size: tuple[int, int], whose: str, path: Path, name: str, advice: str
) -> CaptureError:
    found, wanted = size_of(pixels), f"the shape {_shown(size)}, {whose}"
    return CaptureError.expected(wanted, list(found), got=_shown(found), file=path, name=name, advice=advice)


def _shown(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are one image at two scales, up to a pixel of rounding in the smaller."""
    small, large = sorted((one, other))
    factor = large[0] / small[0]
    return abs(large[1] / factor - small[1]) <= 1
