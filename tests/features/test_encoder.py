"""What encoders are given: images as numbers, and objects without their background."""

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.features.encoder import continue_outside, unit_image
from factories.raising import raises


def disc(size: int = 64, radius: float = 20.0) -> torch.Tensor:
    """Coverage of a disc in the middle of an image."""
    place = torch.arange(size) + 0.5 - size / 2
    return ((place[:, None] ** 2 + place[None, :] ** 2).sqrt() < radius).float()


def test_bytes_and_numbers_give_the_same_image():
    image = torch.arange(192, dtype=torch.uint8).reshape(8, 8, 3)
    assert torch.equal(unit_image(image), unit_image(image.double() / 255))


@pytest.mark.parametrize(
    "image", [torch.full((4, 4, 3), 200.0), torch.full((4, 4, 3), torch.nan), torch.zeros(0, 4, 3)]
)
def test_numbers_that_are_no_image_are_refused(image):
    with raises(SceneError, name="image"):
        unit_image(image)


def test_the_background_has_no_say_and_the_inside_stays():
    coverage = disc()
    color = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    # Masks err by a pixel: what the background shows through at the rim must not matter either.
    white, black = (torch.where(disc(radius=19.3)[..., None] > 0, color, ground) for ground in (1.0, 0.0))
    filled = continue_outside(white, coverage)
    assert torch.equal(filled, continue_outside(black, coverage))
    core = disc(radius=18.0) > 0
    assert torch.equal(filled[core], color[core])


def test_one_color_is_carried_on_unchanged():
    coverage = disc()
    color = torch.where(coverage[..., None] > 0, torch.tensor([0.2, 0.5, 0.7]), torch.tensor([0.9, 0.0, 0.1]))
    # Weighted means in float32.
    torch.testing.assert_close(continue_outside(color, coverage), torch.tensor([0.2, 0.5, 0.7]).expand(64, 64, 3))
