"""What a camera file says of a photograph, and its image, mask and lens made into the view of one pinhole."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf._utils.text import counted, listed
from avmsf.capture.filenames import pictures_in
from avmsf.errors import CaptureError, Remark
from avmsf.photographs.cameras import View
from avmsf.photographs.images import Picture, PictureSizeError, read_mask, read_picture, read_upright, scale
from avmsf.photographs.lenses import Lens, straighten

MAX_SHOTS = 10_000
"""Photographs of one object: a video of five minutes, frame by frame. Splatting uses some hundreds."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph that a camera file names."""

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
class Shots:
    """All that a camera file names."""

    origin: Path
    """The camera file, or the folder that holds its parts."""
    shots: tuple[Shot, ...]
    remarks: tuple[Remark, ...] = ()
    """What looks wrong but was corrected."""


def without_camera(shots: Sequence[Shot], folder: Path) -> list[str]:
    """Return the names of image files that lie among the shots' but have no camera."""
    known = {path.resolve() for shot in shots for path in (shot.image, shot.mask) if path is not None}
    images = folder / "images"
    if images.is_dir():
        candidates = set(pictures_in(images, deep=True))
    else:
        folders = {shot.image.parent for shot in shots}
        candidates = {path for parent in folders for path in pictures_in(parent, deep=False)}
    unlisted = [path for path in candidates if path.resolve() not in known]
    return sorted(path.relative_to(images).as_posix() if images.is_dir() else path.name for path in unlisted)


def refuse_many(count: int, where: Path) -> None:
    """Raise CaptureError for more than `MAX_SHOTS` photographs."""
    if count > MAX_SHOTS:
        raise CaptureError.expected(
            f"at most {MAX_SHOTS:,} photographs", count, file=where, name="photographs", advice="select some hundreds"
        )


def mask_places(shot: Shot, folder: Path) -> list[Path]:
    """Return the paths where a shot's mask may be, the likeliest first."""
    places = mask_names(shot.name, folder)
    return places if shot.mask is None else [shot.mask, *places]


def mask_names(name: str, folder: Path) -> list[Path]:
    """Return the paths where the mask of the photograph of this name may be, the likeliest first."""
    path = PurePosixPath(name)
    return [folder / "masks" / path.with_suffix(".png"), folder / "masks" / f"{path}.png"]


@dataclass
class Findings:
    """Problems of single images, reported together."""

    remarks: list[Remark]
    lost: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    resized: list[str] = field(default_factory=list)
    turned: list[str] = field(default_factory=list)
    unmasked: list[str] = field(default_factory=list)
    stretched: list[str] = field(default_factory=list)

    def summary(self) -> list[Remark]:
        """Return one remark for each kind of finding; its name is the kind, its value the images."""
        kinds = (
            ("missing images", "image", "missing or corrupt, not used", self.lost),
            ("empty masks", "image", "with an empty mask, not used", self.empty),
            ("image sizes", "image", "of another size than the camera, whose intrinsics were scaled", self.resized),
            ("orientations", "image", "rotated by the orientation tag to fit the camera", self.turned),
            ("missing masks", "mask", "missing or corrupt; the images are used without", self.unmasked),
            ("mask sizes", "mask", "scaled from another size to that of the image", self.stretched),
        )
        return self.remarks + [
            Remark(f"{counted(len(images), thing)} {message}: {listed(images)}", name=name, value=images)
            for name, thing, message, images in kinds
            if images
        ]


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
            f"{shot.image}: expected an image of its camera's shape, {lens.width} x {lens.height} ({lens.origin}), got "
            f"{width} x {height}; give the images of which the cameras were estimated, not cropped or rotated",
            file=shot.image,
            name="image",
            value=[width, height],
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
                f"{path}: expected a mask of its image's shape, {width} x {height}, got {mask.shape[1]} x "
                f"{mask.shape[0]}; make the mask of this image",
                file=path,
                name="mask",
                value=[mask.shape[1], mask.shape[0]],
            )
        findings.stretched.append(f"{shot.name} ({mask.shape[1]} x {mask.shape[0]} for {width} x {height})")
        mask = scale(mask, width, height)
    return Picture(picture.color, mask)


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are one picture at two scales, up to a pixel of rounding in the smaller."""
    small, large = sorted((one, other))
    factor = large[0] / small[0]
    return abs(large[1] / factor - small[1]) <= 1
