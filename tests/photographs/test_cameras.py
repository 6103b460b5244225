"""Pinhole cameras and views that cannot be."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from avmsf.errors import CaptureError
from avmsf.photographs.cameras import Camera, View
from factories.raising import raises
from factories.views_folder import HEIGHT, WIDTH, ring


@pytest.mark.parametrize(
    "change", [{"focal": (0.0, 50.0)}, {"width": 0}, {"world_to_camera": torch.full((4, 4), torch.nan)}]
)
def test_a_camera_has_finite_numbers_a_focal_length_and_a_size(change: dict[str, Any]) -> None:
    with raises(CaptureError, name="camera"):
        replace(ring(1)[0], **change)


def test_up_is_not_along_the_line_of_sight() -> None:
    with raises(CaptureError, name="up", value=[0.0, 0.0, 2.0]):
        up = torch.tensor([0.0, 0.0, 2.0])
        Camera.looking(torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3), up=up, focal=5.0, width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize(("image", "mask"), [((8, 9, 3), (HEIGHT, WIDTH)), ((HEIGHT, WIDTH, 3), (8, 9))])
def test_image_and_mask_have_the_size_of_the_camera(image: tuple[int, ...], mask: tuple[int, ...]) -> None:
    pixels, covered = (torch.zeros(size, dtype=torch.uint8) for size in (image, mask))
    with raises(CaptureError, name="a.png", value=[8, 9]):
        View("a.png", pixels, ring(1)[0], covered)
