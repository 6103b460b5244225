"""Photographs and masks as files hold them: PNG, JPEG or WebP, 8 or 16 bit, gray or color, with or without alpha."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageFile, JpegImagePlugin, PngImagePlugin, WebPImagePlugin

from avmsf.errors import CaptureError

MAX_PIXELS = 200_000_000
"""Pixels of a picture: as many as the largest sensors of cameras and telephones have (16,320 x 12,240). Reading one
takes 0.6 GB in 8 bits, 3 GB with 16 bits and alpha; a PNG file of 110 kB may claim 900 million."""
_SIZE = f"at most {MAX_PIXELS:,} pixels"
_HEADERS: tuple[tuple[bytes, type[ImageFile.ImageFile]], ...] = (
    (b"\x89PNG", PngImagePlugin.PngImageFile),
    (b"\xff\xd8", JpegImagePlugin.JpegImageFile),
    (b"RIFF", WebPImagePlugin.WebPImageFile),
)
"""How a file of each kind begins, and what reads its size without its pixels."""


class PictureSizeError(CaptureError):
    """A picture has more than `MAX_PIXELS`."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A photograph's pixels."""

    color: UInt8[np.ndarray, "height width 3"]
    """Red, green, blue."""
    mask: UInt8[np.ndarray, "height width"] | None = None
    """255 on the object, 0 off it."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.color.shape[1], self.color.shape[0]

    def scaled(self, width: int, height: int) -> "Picture":
        """Return the picture with another number of pixels, each the mean over the area that it covers."""
        mask = None if self.mask is None else scale(self.mask, width, height)
        return Picture(scale(self.color, width, height), mask)


def scale(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return an image with another number of pixels: area means downwards, bilinear upwards."""
    if pixels.shape[:2] == (height, width):
        return pixels
    smaller = width <= pixels.shape[1] and height <= pixels.shape[0]
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def read_picture(path: Path) -> Picture:
    """Read a photograph, its pixels as they are stored; alpha becomes the mask and lays the color before black.

    An alpha channel that is opaque everywhere is no mask. 16 bits become 8. An orientation tag (EXIF) has no effect:
    see `read_upright`. Raises CaptureError where the file is missing, corrupt or of another kind, PictureSizeError
    where it has more than `MAX_PIXELS`.
    """
    pixels = _decode(path, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 2:
        return Picture(np.repeat(pixels[..., None], 3, axis=2))
    color = np.ascontiguousarray(pixels[..., 2::-1])
    if pixels.shape[2] == 3 or (pixels[..., 3] == 255).all():
        return Picture(color)
    mask = np.ascontiguousarray(pixels[..., 3])
    # What a transparent pixel's color is nobody knows; before black, edges blend as in a photograph of a black room.
    before_black = (color.astype(np.uint16) * mask[..., None] + 127) // 255
    return Picture(before_black.astype(np.uint8), mask)


def read_upright(path: Path) -> Picture:
    """Read a photograph turned as its orientation tag (EXIF) says, without alpha; raises as `read_picture`."""
    return Picture(np.ascontiguousarray(_decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)[..., ::-1]))


def read_mask(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read a mask: an image's alpha channel where it has one that says something, else its brightness.

    A mask of zeros and ones counts as one of 0 and 255. Raises CaptureError as `read_picture` does.
    """
    pixels = _decode(path, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 3 and pixels.shape[2] == 4 and not (pixels[..., 3] == 255).all():
        mask = pixels[..., 3]
    else:
        # The brightest channel, so that white, red or green paint alike mark the object.
        mask = pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=2)
    return np.ascontiguousarray(mask * 255 if mask.max(initial=0) == 1 else mask)


def _is_small(content: bytes, path: Path) -> bool:
    """Whether a file is a picture by its header; raises PictureSizeError for one of more than `MAX_PIXELS`."""
    read_header = next((header for start, header in _HEADERS if content.startswith(start)), None)
    try:
        if read_header is None:
            return False
        width, height = read_header(io.BytesIO(content)).size
    except Image.DecompressionBombError as error:
        raise PictureSizeError.expected(_SIZE, got=f"more ({error})", file=path, advice="scale it down") from error
    except Exception:  # Pillow raises whatever the parsing of a damaged header raises
        return False
    if width * height > MAX_PIXELS:
        got, advice = f"{width:,} x {height:,}", "scale the picture down"
        raise PictureSizeError.expected(_SIZE, width * height, got=got, file=path, name="pixels", advice=advice)
    return True


def _decode(path: Path, flags: int) -> np.ndarray:
    """Return the file's pixels as 8 bits, blue first where there are colors."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CaptureError.expected("an image file", got=error.strerror, file=path) from error
    pixels = None
    if _is_small(content, path):
        with contextlib.suppress(cv2.error):
            pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    if pixels is None:
        wanted, got = "a complete PNG, JPEG or WebP image", f"{len(content)} bytes that cannot be read"
        advice = "copy or export it again"
        raise CaptureError.expected(wanted, len(content), got=got, file=path, name="bytes", advice=advice)
    if pixels.dtype == np.uint16:
        return ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if pixels.dtype != np.uint8:
        wanted, kind = "8 or 16 bits per channel", str(pixels.dtype)
        raise CaptureError.expected(wanted, kind, got=kind, file=path, name="bits", advice="export it as PNG")
    return pixels
