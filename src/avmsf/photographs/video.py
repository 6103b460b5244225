"""Photographs out of a video: from each stretch of time its sharpest frame."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from avmsf._utils.files import new_folder
from avmsf.errors import CaptureError, CaptureWarning

SHARPNESS_PIXELS = 480
"""Pixels of the longer side on which sharpness is judged: less would hide a slight blur, more measures the noise."""


@dataclass(frozen=True)
class PickedFrame:
    """One frame of a video, written as an image."""

    path: Path
    number: int
    """Counted from 0."""
    sharpness: float
    """Variance of the Laplacian of the brightness, 0 to 255; comparable between frames that show much the same."""


def pick_frames(
    path: str | Path,
    folder: str | Path,
    *,
    count: int,
    suffix: str = ".png",
    progress: Callable[[int, int], None] | None = None,
) -> tuple[PickedFrame, ...]:
    """Divide a video into `count` spans of equal length and write the sharpest frame of each into a new folder.

    Images are called frame_000123.png by their number in the video and stand upright, as the video's rotation tag
    says. The video is read once, with two frames in memory, unless it turns out to be of another length than it
    claims, in which case it is read again. `progress` is called with the frames read and their number as claimed.
    `folder` is whole or absent. Raises CaptureError where the video cannot be read, has fewer than `count` frames, or
    `folder` exists and is not empty; warns with CaptureWarning of a video that ends early.
    """
    path, folder = Path(path), Path(folder)
    if count < 1:
        raise CaptureError(f"count: expected at least 1 frame, got {count}", name="count", value=count)
    if suffix not in (".png", ".jpg"):
        raise CaptureError(f"suffix: expected .png or .jpg, got {suffix!r}", name="suffix", value=suffix)
    claimed = _claimed_frames(path)
    with new_folder(folder, raising=CaptureError) as begun:
        total = claimed if claimed >= count else _read(path, lambda number, frame: None, progress, claimed)
        while True:
            _check_enough(path, total, count)
            read, picked = _pick(path, begun, total=total, count=count, suffix=suffix, progress=progress)
            if read == total:
                break
            # What was picked belongs to spans of another length.
            for frame in picked:
                frame.path.unlink(missing_ok=True)
            total = read
    if total < 0.95 * claimed:
        message = (
            f"{path}: expected {claimed} frames as its header says, got {total}; the frames are selected from these"
        )
        warnings.warn(CaptureWarning(message, file=path, name="frames", value=total), stacklevel=2)
    return tuple(PickedFrame(folder / frame.path.name, frame.number, frame.sharpness) for frame in picked)


def sharpness(frame: np.ndarray) -> float:
    """Return the variance of the Laplacian of a picture's brightness, 0 to 255.

    The picture is [height, width, 3] in 8 bits, blue first; a copy of `SHARPNESS_PIXELS` at most is measured.
    """
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    height, width = gray.shape
    if max(height, width) > SHARPNESS_PIXELS:
        factor = SHARPNESS_PIXELS / max(height, width)
        smaller = (max(1, round(width * factor)), max(1, round(height * factor)))
        gray = cv2.resize(gray, smaller, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def _pick(
    path: Path, folder: Path, *, total: int, count: int, suffix: str, progress: Callable[[int, int], None] | None
) -> tuple[int, list[PickedFrame]]:
    """Write the sharpest frame of each span of a video of `total` frames; return how many it had, and the frames."""
    picked: list[PickedFrame] = []
    best: list[tuple[float, int, np.ndarray]] = []
    span = 0

    def keep() -> None:
        value, number, frame = best.pop()
        target = folder / f"frame_{number:06d}{suffix}"
        if not cv2.imwrite(str(target), frame):
            raise OSError(f"{target.name} was not written")
        picked.append(PickedFrame(target, number, value))

    def consider(number: int, frame: np.ndarray) -> None:
        nonlocal span
        # The last span takes in frames beyond the total, should there be any.
        own = min(number * count // total, count - 1)
        if own > span and best:
            keep()
        span = own
        value = sharpness(frame)
        if not best or value > best[0][0]:
            best[:] = [(value, number, frame)]

    read = _read(path, consider, progress, total)
    if best:
        keep()
    return read, picked


def _read(
    path: Path,
    consider: Callable[[int, np.ndarray], None],
    progress: Callable[[int, int], None] | None,
    total: int,
) -> int:
    """Hand each frame, with its number, to `consider`; return how many there were."""
    video = _open(path)
    try:
        number = 0
        while True:
            there, frame = video.read()
            if not there:
                return number
            consider(number, frame)
            number += 1
            if progress is not None:
                progress(number, max(total, number))
    finally:
        video.release()


def _claimed_frames(path: Path) -> int:
    video = _open(path)
    try:
        return max(0, round(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def _open(path: Path) -> cv2.VideoCapture:
    if not path.is_file():
        raise CaptureError(f"{path}: expected a video file, got none", file=path)
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        video.release()
        raise CaptureError.expected(
            "a video", got="a file that cannot be read", file=path, name="format", advice="convert it to MP4 (H.264)"
        )
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    return video


def _check_enough(path: Path, total: int, count: int) -> None:
    if total == 0:
        raise CaptureError(
            f"{path}: expected a video with frames, got none that can be read; convert it to MP4 (H.264)",
            file=path,
            name="frames",
            value=0,
        )
    if total < count:
        raise CaptureError.expected(
            f"a video of at least {count} frames", total, file=path, name="count", advice=f"choose at most {total}"
        )
