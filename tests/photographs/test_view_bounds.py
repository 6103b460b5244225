"""Pictures and camera files that are too large are refused by what their headers say, before they take time."""

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from avmsf.errors import CaptureError
from avmsf.photographs import read_views
from avmsf.photographs.images import MAX_PIXELS, PictureSizeError, read_mask, read_picture
from avmsf.photographs.shots import MAX_SHOTS
from factories.raising import raises


def black_png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    data = zlib.compress(bytes((1 + (width + 7) // 8) * min(height, 2)))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("read", [read_picture, read_mask])
def test_a_picture_of_too_many_pixels_is_never_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(black_png(30_016, 30_016))
    decoded = []
    monkeypatch.setattr(cv2, "imdecode", lambda *_: decoded.append(path))
    with raises(PictureSizeError, file="bomb.png", value=30_016**2):
        read(path)
    assert not decoded


def test_the_largest_sensors_pictures_are_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert MAX_PIXELS >= 16_320 * 12_240
    path = tmp_path / "large.png"
    path.write_bytes(black_png(16_320, 12_240))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: np.zeros((3, 4, 3), np.uint8))
    assert read_picture(path).size == (4, 3)


def test_a_bomb_among_views_is_named(tmp_path: Path) -> None:
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"{number}.png", "transform_matrix": pose} for number in range(3)]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 5.0, "frames": frames}))
    for number in range(3):
        (tmp_path / f"{number}.png").write_bytes(black_png(8, 8))
    (tmp_path / "1.png").write_bytes(black_png(30_016, 30_016))
    with raises(PictureSizeError, file="1.png"):
        read_views(tmp_path)


def test_too_many_frames_are_refused_before_their_poses(tmp_path: Path) -> None:
    frames = [{"file_path": "0.png", "transform_matrix": "not looked at"}] * (MAX_SHOTS + 1)
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 5.0, "frames": frames}))
    with raises(CaptureError, file="transforms.json", name="photographs", value=MAX_SHOTS + 1):
        read_views(tmp_path)
