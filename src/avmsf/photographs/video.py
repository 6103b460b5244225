"""Photographs out of a video: the sharpest frame of each span of time."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np

from avmsf._utils.files import new_folder
from avmsf.errors import CaptureError, CaptureWarning

SHARPNESS_PIXELS = 480
"""Pixels of the longer side on which sharpness is measured: less would hide a slight blur, more measures the noise."""
_CONVERT = "convert it to MP4 (H.264)"


def pick_frames(path: str | Path, folder: str | Path, *, count: int) -> None:
    """Divide a video into `count` spans of equal length and write the sharpest frame of each into a new folder.

    Images are called frame_000123.png by their number in the video, from 0, and stand upright, as the video's rotation
    tag says. The video is read twice, first to count its frames, with two of them in memory. `folder` is whole or
    absent. Raises CaptureError where the video cannot be read, has fewer than `count` frames, or `folder` exists and is
    not empty; warns with CaptureWarning of a video that ends early.
    """
    path = Path(path)
    if count < 1:
        raise CaptureError.expected("at least 1 frame", count, name="count")
    if not path.is_file():
        raise CaptureError.expected("a video file", file=path)
    with new_folder(Path(folder), raising=CaptureError) as begun:
        with _opened(path) as video:
            claimed = video.get(cv2.CAP_PROP_FRAME_COUNT)
            total = sum(1 for _ in iter(video.grab, False))
        if total == 0:
            wanted, got = "a video with frames", "none that can be read"
            raise CaptureError.expected(wanted, 0, got=got, file=path, name="frames", advice=_CONVERT)
        if total < count:
            wanted, advice = f"a video of at least {count} frames", f"choose at most {total}"
            raise CaptureError.expected(wanted, total, file=path, name="count", advice=advice)
        for _, span in groupby(enumerate(_frames(path)), lambda frame: frame[0] * count // total):
            number, sharpest = max(span, key=lambda frame: sharpness(frame[1]))
            target = begun / f"frame_{number:06d}.png"
            if not cv2.imwrite(str(target), sharpest):
                raise OSError(f"{target.name} was not written")
    if total < 0.95 * claimed:
        wanted, advice = f"{claimed:.0f} frames as its header says", "the frames are selected from these"
        warning = CaptureWarning.expected(wanted, total, file=path, name="frames", advice=advice)
        warnings.warn(warning, stacklevel=2)


def sharpness(frame: np.ndarray) -> float:
    """Return the variance of the Laplacian of an image's brightness, 0 to 255.

    The image is [height, width, 3] in 8 bits, blue first; a copy of `SHARPNESS_PIXELS` at most is measured.
    """
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    factor = SHARPNESS_PIXELS / max(gray.shape)
    if factor < 1:
        size = [max(1, round(side * factor)) for side in gray.shape[::-1]]
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def _frames(path: Path) -> Iterator[np.ndarray]:
    with _opened(path) as video:
        while (taken := video.read())[0]:
            yield taken[1]


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        got = "a file that cannot be read"
        raise CaptureError.expected("a video", got=got, file=path, name="format", advice=_CONVERT)
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    try:
        yield video
    finally:
        video.release()
