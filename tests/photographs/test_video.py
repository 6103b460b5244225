"""Frames out of videos that the test writes, some of them blurred."""

import struct
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs.video import pick_frames
from factories.raising import raises, warns

SHARP = (2, 11, 13, 21, 28, 30)
"""Of 36 frames, one in each sixth that is not blurred."""


def picture(number: int, *, blurred: bool) -> np.ndarray:
    """Fine noise whose brightness in the corner tells the frame's number."""
    frame = np.random.default_rng(number).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    frame = cv2.resize(frame[::2, ::2], (96, 64), interpolation=cv2.INTER_NEAREST)
    if blurred:
        frame = cv2.GaussianBlur(frame, (0, 0), 2.0)
    frame[:16, :16] = 7 * number
    return frame


def film(path: Path, *, count: int = 36, codec: str = "MJPG", sharp: tuple[int, ...] = SHARP) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30.0, (96, 64))
    assert writer.isOpened()
    for number in range(count):
        writer.write(picture(number, blurred=number not in sharp))
    writer.release()
    return path


def pick(video: Path, folder: Path, count: int) -> list[Path]:
    pick_frames(video, folder, count=count)
    return sorted(folder.iterdir())


def names(numbers: Iterable[int]) -> list[str]:
    return [f"frame_{number:06d}.png" for number in numbers]


def test_the_sharp_frame_of_each_span_is_kept(tmp_path: Path) -> None:
    picked = pick(film(tmp_path / "a.avi"), tmp_path / "images", 6)
    assert [path.name for path in picked] == names(SHARP)
    for path, number in zip(picked, SHARP, strict=True):
        # What the frame shows, up to JPEG's error.
        assert abs(float(cv2.imread(str(path))[4:12, 4:12].mean()) - 7 * number) < 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.avi", "images"]


def turn(path: Path) -> None:
    """Write a turn by 90 degrees clockwise into the matrix of an MP4's track header."""
    content = bytearray(path.read_bytes())
    place = content.index(b"tkhd") + 4
    assert content[place] == 0
    # Version and flags, times, track, reserved, duration: 24 bytes; reserved, layer, group, volume: 16 more.
    start = place + 24 + 16
    struct.pack_into(">9i", content, start, 0, 0x10000, 0, -0x10000, 0, 0, 64 << 16, 0, 0x40000000)
    path.write_bytes(content)


def test_a_video_taken_upright_is_written_upright(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", count=4, codec="mp4v", sharp=(0, 1, 2, 3))
    plain = pick(path, tmp_path / "plain", 4)[0]
    turn(path)
    turned = pick(path, tmp_path / "turned", 4)[0]
    lying, upright = cv2.imread(str(plain)), cv2.imread(str(turned))
    assert lying.shape == (64, 96, 3)
    assert np.array_equal(upright, cv2.rotate(lying, cv2.ROTATE_90_CLOCKWISE))


@pytest.mark.parametrize("claimed", [0, 35, 90])
def test_spans_go_by_the_frames_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, claimed: int) -> None:
    film(tmp_path / "a.avi")

    opened = cv2.VideoCapture

    class Claiming:
        def __init__(self, path: str) -> None:
            self.video = opened(path)

        def get(self, what: int) -> float:
            return claimed if what == cv2.CAP_PROP_FRAME_COUNT else self.video.get(what)

        def __getattr__(self, name: str) -> object:
            return getattr(self.video, name)

    monkeypatch.setattr(cv2, "VideoCapture", Claiming)
    ended_early = warns(CaptureWarning, file="a.avi", name="frames", value=36) if claimed == 90 else nullcontext()
    with ended_early:
        picked = pick(tmp_path / "a.avi", tmp_path / "images", 6)
    assert [path.name for path in picked] == names(SHARP)


def test_what_cannot_be_picked_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    with raises(CaptureError, file="none.mp4", name=None):
        pick_frames(tmp_path / "none.mp4", tmp_path / "images", count=3)
    (tmp_path / "text.mp4").write_text("no video")
    with raises(CaptureError, file="text.mp4", name="format"):
        pick_frames(tmp_path / "text.mp4", tmp_path / "images", count=3)
    short = film(tmp_path / "short.avi", count=4)
    with raises(CaptureError, file="short.avi", name="count", value=4):
        pick_frames(short, tmp_path / "images", count=5)
    with raises(CaptureError, name="count", value=0):
        pick_frames(short, tmp_path / "images", count=0)
    pick_frames(short, tmp_path / "full", count=2)
    with raises(CaptureError, file="full"):
        pick_frames(short, tmp_path / "full", count=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["full", "short.avi", "text.mp4"]
