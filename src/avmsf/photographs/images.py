"""Images and masks as files hold them: PNG, JPEG or WebP, 8 or 16 bit, gray or color, with or without alpha."""

import contextlib
import io
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageFile, JpegImagePlugin, PngImagePlugin, WebPImagePlugin

from avmsf.errors import CaptureError

MAX_PIXELS = 200_000_000
"""Pixels of an image: as many as the largest sensors of cameras and telephones have (16,320 x 12,240). Reading one
takes 0.6 GB in 8 bits, 3 GB with 16 bits and alpha; a PNG file of 110 kB may claim 900 million."""
_HEADERS: tuple[tuple[bytes, type[ImageFile.ImageFile]], ...] = (
    (b"\x89PNG", PngImagePlugin.PngImageFile),
    (b"\xff\xd8", JpegImagePlugin.JpegImageFile),
    (b"RIFF", WebPImagePlugin.WebPImageFile),
)
"""How a file of each kind begins, and what reads its size without its pixels."""


class UnreadableImageError(CaptureError):
    """An image file is missing, corrupt or of another kind."""


def read_image(path: Path, *, upright: bool = False) -> UInt8[np.ndarray, "height width channels"]:
    """Read an image, its pixels as they are stored: red, green, blue, and alpha, which is the mask, where it has one.

    Alpha lays the color before black; where it is opaque everywhere it is no mask, and there are three channels. 16
    bits become 8. With `upright` the image is rotated as its orientation tag (EXIF) says, and has no alpha. Raises
    UnreadableImageError, and CaptureError for more than `MAX_PIXELS`.
    """
    pixels = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH if upright else cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 3 or (pixels[..., 3] == 255).all():
        return np.ascontiguousarray(pixels[..., 2::-1])
    image = np.ascontiguousarray(pixels[..., [2, 1, 0, 3]])
    # A transparent pixel's color is unknown; before black, edges blend as in a photograph of a black room.
    image[..., :3] = (image[..., :3].astype(np.uint16) * image[..., 3:] + 127) // 255
    return image


def read_mask(path: Path) -> UInt8[np.ndarray, "height width"]:
    """Read a mask: an image's alpha channel where it has one that says something, else its brightness.

    A mask of zeros and ones counts as one of 0 and 255. Raises as `read_image`.
    """
    pixels = _decode(path, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 3 and pixels.shape[2] == 4 and not (pixels[..., 3] == 255).all():
        mask = pixels[..., 3]
    else:
        # The brightest channel, so that white, red or green paint alike mark the object.
        mask = pixels if pixels.ndim == 2 else pixels[..., :3].max(axis=2)
    return np.ascontiguousarray(mask * 255 if mask.max(initial=0) == 1 else mask)


def size_of(pixels: np.ndarray) -> tuple[int, int]:
    """Return an image's width and height, pixels."""
    return pixels.shape[1], pixels.shape[0]


def scale(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return an image with another number of pixels: area means downwards, bilinear upwards."""
    if size_of(pixels) == (width, height):
        return pixels
    smaller = width <= pixels.shape[1] and height <= pixels.shape[0]
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def _decode(path: Path, flags: int) -> np.ndarray:
    """Return the file's pixels as 8 bits, blue first where there are colors."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UnreadableImageError.expected("an image file", got=error.strerror, file=path) from error
    pixels = None
    if _has_header(content, path):
        with contextlib.suppress(cv2.error):
            pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    if pixels is None:
        wanted, got = "a complete PNG, JPEG or WebP image", f"{len(content)} bytes that cannot be read"
        advice = "copy or export it again"
        raise UnreadableImageError.expected(wanted, len(content), got=got, file=path, name="bytes", advice=advice)
    if pixels.dtype == np.uint16:
        return ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if pixels.dtype != np.uint8:
        wanted, kind = "8 or 16 bits per channel", str(pixels.dtype)
        raise UnreadableImageError.expected(wanted, kind, got=kind, file=path, name="bits", advice="export it as PNG")
    return pixels


def _has_header(content: bytes, path: Path) -> bool:
    """Whether a file is an image by its header; raises CaptureError for one of more than `MAX_PIXELS`."""
    wanted, advice = f"at most {MAX_PIXELS:,} pixels", "scale it down"
    read_header = next((header for start, header in _HEADERS if content.startswith(start)), None)
    try:
        if read_header is None:
            return False
        width, height = read_header(io.BytesIO(content)).size
    except Image.DecompressionBombError as error:
        raise CaptureError.expected(wanted, got=f"more ({error})", file=path, advice=advice) from error
    except Exception:  # the parser's own, of any type, for a damaged header
        return False
    if width * height > MAX_PIXELS:
        got, count = f"{width:,} x {height:,}", width * height
        raise CaptureError.expected(wanted, count, got=got, file=path, name="pixels", advice=advice)
    return True
