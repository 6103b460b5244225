"""What a camera file says of one photograph, before any pixel is read."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from jaxtyping import Float
from torch import Tensor

from avmsf.capture.filenames import pictures_in
from avmsf.errors import CaptureError, Remark
from avmsf.photographs.lenses import Lens

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
    strangers = [path for path in candidates if path.resolve() not in known]
    return sorted(path.relative_to(images).as_posix() if images.is_dir() else path.name for path in strangers)


def refuse_many(count: int, where: Path) -> None:
    """Raise CaptureError for more than `MAX_SHOTS` photographs."""
    if count > MAX_SHOTS:
        raise CaptureError(
            f"{where}: expected at most {MAX_SHOTS:,} photographs, got {count:,}; select some hundreds",
            file=where,
            name="photographs",
            value=count,
        )


def mask_places(shot: Shot, folder: Path) -> list[Path]:
    """Return the paths where a shot's mask may be, the likeliest first."""
    places = mask_names(shot.name, folder)
    return places if shot.mask is None else [shot.mask, *places]


def mask_names(name: str, folder: Path) -> list[Path]:
    """Return the paths where the mask of the photograph of this name may be, the likeliest first."""
    path = PurePosixPath(name)
    return [folder / "masks" / path.with_suffix(".png"), folder / "masks" / f"{path}.png"]


def listed(names: Sequence[str], *, most: int = 5) -> str:
    """Return the first names and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
