"""Images and masks of every kind are read as the pixels that they show, and frames out of videos."""

import struct
import zlib
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from avmsf.errors import CaptureError, CaptureWarning
from avmsf.photographs import read_views
from avmsf.photographs.images import MAX_PIXELS, read_image, read_mask
from avmsf.photographs.video import pick_frames
from factories.raising import raises, warns
from factories.views_folder import HEIGHT, WIDTH, frames, ring, write_image, write_transforms

ACROSS, DOWN = np.meshgrid(np.linspace(20, 230, WIDTH), np.linspace(10, 200, HEIGHT))
RAMP = np.round(np.dstack([ACROSS, DOWN, np.full_like(DOWN, 60)])).astype(np.uint8)


def folder_of(folder: Path, image: np.ndarray | None = None, **settings: object) -> Path:
    """A ring of four views of one image."""
    rows = frames(ring(4))
    write_transforms(folder, rows, images=False, **settings)
    for row in rows:
        write_image(folder / row["file_path"], RAMP if image is None else image)
    return folder


# The largest error that each kind of compression may make on a ramp, in levels of 255.
@pytest.mark.parametrize(("suffix", "tolerance"), [(".png", 0), (".jpg", 12), (".webp", 12)])
def test_channels_are_red_green_blue(tmp_path: Path, suffix: str, tolerance: int) -> None:
    Image.fromarray(RAMP).save(tmp_path / f"a{suffix}", quality=95)
    image = read_image(tmp_path / f"a{suffix}")
    assert image.shape == RAMP.shape
    assert np.abs(image.astype(int) - RAMP).max() <= tolerance


def test_gray_and_sixteen_bits_show_the_same(tmp_path: Path) -> None:
    gray, alpha = RAMP[..., 0], np.where(np.arange(WIDTH) < 9, 255, 0).astype(np.uint8) + np.zeros_like(RAMP[..., 0])
    cv2.imwrite(str(tmp_path / "8.png"), gray)
    # 257 is 65535 / 255; half a level more still rounds down.
    cv2.imwrite(str(tmp_path / "16.png"), gray.astype(np.uint16) * 257 + 128)
    cv2.imwrite(str(tmp_path / "color.png"), RAMP[..., ::-1].astype(np.uint16) * 257 - 128)
    Image.fromarray(np.dstack([gray, alpha]), "LA").save(tmp_path / "alpha.png")
    write_image(tmp_path / "opaque.png", np.dstack([RAMP, np.full_like(alpha, 255)]))
    for name in ("8", "16"):
        assert np.array_equal(read_image(tmp_path / f"{name}.png"), np.repeat(gray[..., None], 3, axis=2))
    for name in ("color", "opaque"):
        assert np.array_equal(read_image(tmp_path / f"{name}.png"), RAMP)
    image = read_image(tmp_path / "alpha.png")
    assert np.array_equal(image[..., 3], alpha)
    assert np.array_equal(image[:, :9, 1], gray[:, :9])


def test_alpha_is_the_mask_and_lays_the_object_before_black(tmp_path: Path) -> None:
    alpha = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    alpha[:, 10:20], alpha[:, 20] = 255, 51
    view = read_views(folder_of(tmp_path, np.dstack([RAMP, alpha])))[0]
    assert np.array_equal(view.mask.numpy(), alpha)
    # 51 is a fifth of 255.
    assert np.abs(view.image.numpy() - RAMP * (alpha[..., None] / 255)).max() <= 0.5


def test_masks_of_zeros_and_ones_colors_or_alpha(tmp_path: Path) -> None:
    object_there = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    object_there[5:9, 4:30] = 1
    red = np.dstack([object_there * 255, object_there * 0, object_there * 0])
    write_image(tmp_path / "ones.png", object_there)
    write_image(tmp_path / "red.png", red)
    write_image(tmp_path / "alpha.png", np.dstack([RAMP, object_there * 255]))
    Image.fromarray(object_there > 0).save(tmp_path / "bits.png")
    for name in ("ones", "red", "alpha", "bits"):
        assert np.array_equal(read_mask(tmp_path / f"{name}.png"), object_there * 255), name


def test_a_mask_of_another_size_is_scaled_or_refused(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    mask = np.zeros((2 * HEIGHT, 2 * WIDTH), dtype=np.uint8)
    mask[:, : 2 * 7] = 255
    write_image(folder / "masks" / "b.png", mask)
    with warns(CaptureWarning, name="mask sizes", value=["b.png (80 x 60 for 40 x 30)"]):
        views = read_views(folder)
    assert (views[1].mask.numpy() == np.where(np.arange(WIDTH) < 7, 255, 0)).all()
    write_image(folder / "masks" / "b.png", mask[:HEIGHT])
    with raises(CaptureError, file="masks/b.png", name="mask", value=[80, 30]):
        read_views(folder)
    with raises(CaptureError, file="images/a.png", name="image", value=[30, 30]):
        read_views(folder_of(tmp_path / "other", RAMP[:, :30]))


def test_masks_without_object_drop_their_views(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    empty = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    write_image(folder / "masks" / "b.png", empty)
    with warns(CaptureWarning, name="empty masks", value=["b.png"]):
        assert [view.name for view in read_views(folder)] == ["a.png", "c.png", "d.png"]
    for name in "acd":
        write_image(folder / "masks" / f"{name}.png", empty)
    with raises(CaptureError, file="transforms.json", name="masks", value=0):
        read_views(folder)


def test_masks_that_are_named_but_not_there(tmp_path: Path) -> None:
    rows = frames(ring(4))
    rows[1]["mask_path"], rows[2]["mask_path"] = "masks/gone.png", "masks/broken.png"
    folder = write_transforms(tmp_path, rows)
    (folder / "masks").mkdir()
    (folder / "masks" / "broken.png").write_bytes(b"no image")
    with warns(CaptureWarning, file="transforms.json", name="missing masks", value=["b.png", "c.png"]):
        views = read_views(folder)
    assert all(view.mask is None for view in views)


@pytest.mark.parametrize(
    "damage",
    [
        Path.unlink,
        lambda path: path.write_bytes(path.read_bytes()[:-40]),
        lambda path: path.write_text("not an image"),
        lambda path: path.write_bytes(b""),
    ],
    ids=["missing", "cut short", "text", "empty"],
)
def test_missing_and_corrupt_images_are_left_out_and_those_without_cameras_named(tmp_path: Path, damage) -> None:
    folder = folder_of(tmp_path)
    damage(folder / "images" / "c.png")
    write_image(folder / "images" / "late" / "x.png")
    with warns(CaptureWarning, name="cameras", value=["late/x.png"]):
        read_views(folder)
    with warns(CaptureWarning, file="transforms.json", name="missing images", value=["c.png"]):
        assert [view.name for view in read_views(folder)] == ["a.png", "b.png", "d.png"]
    damage(folder / "images" / "a.png")
    with raises(CaptureError, file="transforms.json", name="views", value=2):
        read_views(folder)
    # A JPEG is decoded as far as it goes, and yet is corrupt.
    Image.fromarray(np.kron(RAMP, np.ones((8, 8, 1), dtype=np.uint8))).save(tmp_path / "a.jpg")
    content = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(content[: len(content) * 2 // 3])
    with raises(CaptureError, file="a.jpg", name="bytes", value=len(content) * 2 // 3):
        read_image(tmp_path / "a.jpg")


def test_no_views_are_not_read(tmp_path: Path) -> None:
    with raises(CaptureError, name="max_views", value=0):
        read_views(tmp_path, max_views=0)


def test_longest_averages_areas_and_takes_the_camera_along(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    folder = folder_of(tmp_path, image)
    view = read_views(folder, longest=20)[0]
    means = image.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(view.image.numpy() - means).max() <= 0.5
    assert view.camera.focal == (25.0, 26.0)
    assert view.camera.principal == (9.5, 8.0)
    for size in (WIDTH, 1000):
        assert np.array_equal(read_views(folder, longest=size)[0].image.numpy(), image)


def test_images_of_another_size_scale_the_intrinsics(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, np.kron(RAMP, np.ones((3, 3, 1), dtype=np.uint8)))
    sizes = [f"{name}.png (120 x 90 instead of 40 x 30)" for name in "abcd"]
    with warns(CaptureWarning, name="image sizes", value=sizes):
        camera = read_views(folder)[0].camera
    assert (camera.width, camera.height) == (120, 90)
    assert camera.focal == (150.0, 156.0)
    assert camera.principal == (57.0, 48.0)


# EXIF's tag 0x0112: 6 means that the stored image must be turned clockwise by a quarter, 3 by a half.
def save_turned(path: Path, image: np.ndarray, orientation: int) -> None:
    tags = Image.Exif()
    tags[0x0112] = orientation
    Image.fromarray(image).save(path, exif=tags, quality=95, subsampling=0)


def test_orientation_tags_turn_only_what_fits_its_camera_no_other_way(tmp_path: Path) -> None:
    rows = frames(ring(3))
    for row in rows:
        row["file_path"] = row["file_path"].replace(".png", ".jpg")
    write_transforms(tmp_path, rows, images=False)
    (tmp_path / "images").mkdir()
    # As stored: what structure from motion and the NeRF tools read.
    save_turned(tmp_path / "images" / "a.jpg", RAMP, 3)
    save_turned(tmp_path / "images" / "b.jpg", RAMP, 1)
    # A quarter back, so that the tag's clockwise quarter gives the ramp.
    save_turned(tmp_path / "images" / "c.jpg", np.rot90(RAMP).copy(), 6)
    with warns(CaptureWarning, name="orientations", value=["c.jpg"]):
        views = read_views(tmp_path)
    for view in views:
        assert np.abs(view.image.numpy().astype(int) - RAMP).max() <= 12


@pytest.mark.parametrize("read", [read_image, read_mask])
def test_a_picture_of_too_many_pixels_is_never_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read) -> None:
    # The largest sensors'.
    assert MAX_PIXELS >= 16_320 * 12_240
    write_image(tmp_path / "bomb.png", RAMP)
    content = bytearray((tmp_path / "bomb.png").read_bytes())
    # Width and height of the header, and its check sum.
    content[16:24] = struct.pack(">II", 30_016, 30_016)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    (tmp_path / "bomb.png").write_bytes(content)
    monkeypatch.setattr(cv2, "imdecode", None)
    with raises(CaptureError, file="bomb.png", name="pixels", value=30_016**2):
        read(tmp_path / "bomb.png")


SHARP = (2, 11, 13, 21, 28, 30)
"""Of 36 frames, one in each sixth that is not blurred."""


def film(path: Path, *, count: int = 36, codec: str = "MJPG", sharp: tuple[int, ...] = SHARP) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 30.0, (96, 64))
    assert writer.isOpened()
    for number in range(count):
        # Fine noise whose brightness in the corner tells the frame's number.
        frame = np.random.default_rng(number).integers(0, 256, (64, 96, 3), dtype=np.uint8)
        frame = cv2.resize(frame[::2, ::2], (96, 64), interpolation=cv2.INTER_NEAREST)
        if number not in sharp:
            frame = cv2.GaussianBlur(frame, (0, 0), 2.0)
        frame[:16, :16] = 7 * number
        writer.write(frame)
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


def test_a_video_taken_upright_is_written_upright(tmp_path: Path) -> None:
    path = film(tmp_path / "a.mp4", count=4, codec="mp4v", sharp=(0, 1, 2, 3))
    plain = pick(path, tmp_path / "plain", 4)[0]
    # A turn by 90 degrees clockwise in the matrix of the track's header, behind version and flags, times, track,
    # reserved and duration (24 bytes), and reserved, layer, group and volume (16 more).
    content = bytearray(path.read_bytes())
    start = content.index(b"tkhd") + 4
    assert content[start] == 0
    struct.pack_into(">9i", content, start + 40, 0, 0x10000, 0, -0x10000, 0, 0, 64 << 16, 0, 0x40000000)
    path.write_bytes(content)
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
    assert sorted(path.name for path in tmp_path.iterdir()) == ["short.avi", "text.mp4"]
