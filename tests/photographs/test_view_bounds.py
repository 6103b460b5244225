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


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3), (5, 7, 4)])
def test_small_pictures_of_every_kind_are_read(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    path = tmp_path / f"small{suffix}"
    path.write_bytes(cv2.imencode(suffix, np.full(shape, 90, np.uint8))[1].tobytes())
    assert read_picture(path).size == (7, 5)


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


@pytest.mark.parametrize(
    "changes", [{"fl_x": 10**400}, {"transform_matrix": [[10**400] * 4] * 4}], ids=["focal", "pose"]
)
def test_whole_numbers_beyond_every_float_are_refused(tmp_path: Path, changes: dict) -> None:
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 5.0}
    (tmp_path / "0.png").write_bytes(cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame | changes]}))
    with raises(CaptureError, file="transforms.json", row=0, name=next(iter(changes))):
        read_views(tmp_path)


def test_json_nested_beyond_reason_is_refused(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_text("[" * 100_000)
    with raises(CaptureError, file="transforms.json"):
        read_views(tmp_path)
