"""One shot's image, mask and lens made into one pinhole's view."""

from dataclasses import dataclass, field
from pathlib import Path

import torch

from avmsf.capture.cameras import View
from avmsf.capture.views.lenses import Lens, straighten
from avmsf.capture.views.pictures import Picture, PictureSizeError, read_mask, read_picture, read_upright, scale
from avmsf.capture.views.shots import Shot, listed, mask_places
from avmsf.errors import CaptureError


@dataclass
class Findings:
    """What went wrong with single images, to be said once for all."""

    remarks: list[str]
    lost: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    resized: list[str] = field(default_factory=list)
    turned: list[str] = field(default_factory=list)
    unmasked: list[str] = field(default_factory=list)
    stretched: list[str] = field(default_factory=list)

    def summary(self) -> list[str]:
        """Return one sentence for each kind of finding."""
        kinds = {
            "images are missing or corrupt and are left out": self.lost,
            "images have a mask without any object in it and are left out": self.empty,
            "images have another size than their cameras say, whose intrinsics were scaled": self.resized,
            "images were turned as their orientation tag says, for only so they fit their cameras": self.turned,
            "masks are named but missing or corrupt; these images go without": self.unmasked,
            "masks have another size than their images and were scaled": self.stretched,
        }
        return self.remarks + [f"{len(names)} {kind}: {listed(names)}" for kind, names in kinds.items() if names]


def read_view(shot: Shot, base: Path, longest: int | None, meters: float, findings: Findings) -> View | None:
    """Read one shot's image and mask into a pinhole's view; None, and a finding, where there is nothing to see."""
    try:
        picture = read_picture(shot.image)
    except PictureSizeError:
        raise
    except CaptureError:
        findings.lost.append(shot.name)
        return None
    picture, lens = _fit(shot, picture, findings)
    picture = _with_mask(shot, base, picture, findings)
    picture, lens = straighten(picture, lens)
    if longest is not None and max(picture.size) > longest:
        width, height = (max(1, round(side * longest / max(picture.size))) for side in picture.size)
        picture, lens = picture.scaled(width, height), lens.resized(width, height)
    if picture.mask is not None and not picture.mask.any():
        findings.empty.append(shot.name)
        return None
    pose = shot.world_to_camera.clone()
    pose[:3, 3] *= meters
    mask = None if picture.mask is None else torch.from_numpy(picture.mask)
    return View(shot.name, torch.from_numpy(picture.color), lens.camera(pose), mask)


def _fit(shot: Shot, picture: Picture, findings: Findings) -> tuple[Picture, Lens]:
    """Return picture and lens of one size; raises CaptureError where their shapes differ."""
    lens = shot.lens_of(*picture.size)
    if picture.size == (lens.width, lens.height):
        return picture, lens
    if picture.mask is None:
        upright = read_upright(shot.image)
        if upright.size != picture.size and _same_shape(upright.size, (lens.width, lens.height)):
            picture = upright
            findings.turned.append(shot.name)
    width, height = picture.size
    if (width, height) == (lens.width, lens.height):
        return picture, lens
    if not _same_shape((width, height), (lens.width, lens.height)):
        raise CaptureError(
            f"{shot.image}: the image has {width} x {height} pixels, its camera ({lens.origin}) {lens.width} x "
            f"{lens.height}, another shape: give the images that the cameras were found for, not cropped or turned"
        )
    findings.resized.append(f"{shot.name} ({width} x {height} instead of {lens.width} x {lens.height})")
    return picture, lens.resized(width, height)


def _with_mask(shot: Shot, base: Path, picture: Picture, findings: Findings) -> Picture:
    """Return the picture with the mask that lies in a file, where it has none of its own."""
    if picture.mask is not None:
        return picture
    path = next((place for place in mask_places(shot, base) if place.is_file()), None)
    if path is None:
        if shot.mask is not None:
            findings.unmasked.append(shot.name)
        return picture
    try:
        mask = read_mask(path)
    except PictureSizeError:
        raise
    except CaptureError:
        findings.unmasked.append(shot.name)
        return picture
    width, height = picture.size
    if mask.shape != (height, width):
        if not _same_shape((mask.shape[1], mask.shape[0]), (width, height)):
            raise CaptureError(
                f"{path}: the mask has {mask.shape[1]} x {mask.shape[0]} pixels, its image {width} x {height}, another "
                "shape: make the mask of this very image"
            )
        findings.stretched.append(f"{shot.name} ({mask.shape[1]} x {mask.shape[0]} for {width} x {height})")
        mask = scale(mask, width, height)
    return Picture(picture.color, mask)


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are one picture at two scales, up to a pixel of rounding in the smaller."""
    small, large = sorted((one, other))
    factor = large[0] / small[0]
    return abs(large[1] / factor - small[1]) <= 1
