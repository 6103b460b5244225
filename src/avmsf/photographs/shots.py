"""What a camera file says of a photograph, and its image, mask and lens made into the view of one pinhole."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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


def mask_names(name: str, folder: Path) -> list[Path]:
    """Return the paths where the mask of the photograph of this name may be, the likeliest first."""
    path = PurePosixPath(name)
    return [folder / "masks" / path.with_suffix(".png"), folder / "masks" / f"{path}.png"]


KINDS = {
    "missing images": ("image", "missing or corrupt, not used"),
    "empty masks": ("image", "with an empty mask, not used"),
    "image sizes": ("image", "of another size than the camera, whose intrinsics were scaled"),
    "orientations": ("image", "rotated by the orientation tag to fit the camera"),
    "missing masks": ("mask", "missing or corrupt; the images are used without"),
    "mask sizes": ("mask", "scaled from another size to that of the image"),
}
"""Problems of single images, which are reported together: what they concern, and what became of it."""


def summarize(findings: Mapping[str, Sequence[str]]) -> list[Remark]:
    """Return one remark for each kind of finding of `KINDS`; its value is the images."""
    return [
        Remark(f"{counted(len(findings[name]), thing)} {message}: {listed(findings[name])}", name, findings[name])
        for name, (thing, message) in KINDS.items()
        if name in findings
    ]


def read_view(
    shot: Shot, base: Path, longest: int | None, meters: float, findings: defaultdict[str, list[str]]
) -> View | None:
    """Read one shot's image and mask into a pinhole's view; None, and a finding, where there is nothing to see."""
    try:
        picture = read_picture(shot.image)
    except PictureSizeError:
        raise
    except CaptureError:
        findings["missing images"].append(shot.name)
        return None
    picture, lens = _fit(shot, picture, findings)
    picture = _with_mask(shot, base, picture, findings)
    picture, lens = straighten(picture, lens)
    if longest is not None and max(picture.size) > longest:
        width, height = (max(1, round(side * longest / max(picture.size))) for side in picture.size)
        picture, lens = picture.scaled(width, height), lens.resized(width, height)
    if picture.mask is not None and not picture.mask.any():
        findings["empty masks"].append(shot.name)
        return None
    pose = shot.world_to_camera.clone()
    pose[:3, 3] *= meters
    mask = None if picture.mask is None else torch.from_numpy(picture.mask)
    return View(shot.name, torch.from_numpy(picture.color), lens.camera(pose), mask)


def _fit(shot: Shot, picture: Picture, findings: defaultdict[str, list[str]]) -> tuple[Picture, Lens]:
    """Return picture and lens of one size; raises CaptureError where their shapes differ."""
    lens = shot.lens_of(*picture.size)
    size = (lens.width, lens.height)
    if picture.mask is None and picture.size != size:
        upright = read_upright(shot.image)
        if upright.size != picture.size and _same_shape(upright.size, size):
            picture = upright
            findings["orientations"].append(shot.name)
    if picture.size == size:
        return picture, lens
    whose, advice = f"its camera's ({lens.origin})", "give the images of which the cameras were estimated, not cropped"
    _expect_shape(picture.size, size, shot.image, "image", whose=whose, advice=f"{advice} or rotated")
    findings["image sizes"].append(f"{shot.name} ({_shown(picture.size)} instead of {_shown(size)})")
    return picture, lens.resized(*picture.size)


def _with_mask(shot: Shot, base: Path, picture: Picture, findings: defaultdict[str, list[str]]) -> Picture:
    """Return the picture with the mask that lies in a file, where it has none of its own."""
    if picture.mask is not None:
        return picture
    places = [*([] if shot.mask is None else [shot.mask]), *mask_names(shot.name, base)]
    path = next((place for place in places if place.is_file()), shot.mask)
    if path is None:
        return picture
    try:
        mask = read_mask(path)
    except PictureSizeError:
        raise
    except CaptureError:
        findings["missing masks"].append(shot.name)
        return picture
    size = (mask.shape[1], mask.shape[0])
    if size != picture.size:
        _expect_shape(size, picture.size, path, "mask", whose="its image's", advice="make the mask of this image")
        findings["mask sizes"].append(f"{shot.name} ({_shown(size)} for {_shown(picture.size)})")
        mask = scale(mask, *picture.size)
    return Picture(picture.color, mask)


def _expect_shape(
    found: tuple[int, int], wanted: tuple[int, int], path: Path, name: str, *, whose: str, advice: str
) -> None:
    if not _same_shape(found, wanted):
        shape = f"the shape {_shown(wanted)}, {whose}"
        raise CaptureError.expected(shape, list(found), got=_shown(found), file=path, name=name, advice=advice)


def _shown(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are one picture at two scales, up to a pixel of rounding in the smaller."""
    small, large = sorted((one, other))
    factor = large[0] / small[0]
    return abs(large[1] / factor - small[1]) <= 1
