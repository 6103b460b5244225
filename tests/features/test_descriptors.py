"""The embedded encoder: it knows colors and textures, not which way up or how large an image is."""

import math

import pytest
import torch

from avmsf.features.descriptors import ImageDescriptors

NAMES = ("L", "a", "b", "gradient", "first", "second", "third", "fourth", "larger", "smaller", "next L", "next a")


def picture(size: int = 256, *, angle: float = 0.0) -> torch.Tensor:
    """Smooth colored waves of 12 to 60 pixels (at 256), turned about the image's middle by `angle`, radians."""
    place = (torch.arange(size, dtype=torch.float64) + 0.5) / size - 0.5
    down, across = torch.meshgrid(place, place, indexing="ij")
    x = math.cos(angle) * across + math.sin(angle) * down
    y = -math.sin(angle) * across + math.cos(angle) * down
    generator = torch.Generator().manual_seed(3)
    waves = torch.randn(12, 5, generator=generator, dtype=torch.float64)
    color = torch.zeros(size, size, 3, dtype=torch.float64)
    for row, (a, b, *mix) in enumerate(waves.tolist()):
        phase = torch.sin(12 * (a * x + b * y) * (1 + row / 6) + row)
        color += phase[..., None] * torch.tensor(mix, dtype=torch.float64) / 12
    return (0.5 + color).clamp(0, 1).float()


def middle(features: torch.Tensor) -> torch.Tensor:
    """Features far from the borders, where a turned image shows the same."""
    rows, columns = features.shape[1:]
    place_down, place_across = torch.meshgrid(
        torch.arange(rows) + 0.5 - rows / 2, torch.arange(columns) + 0.5 - columns / 2, indexing="ij"
    )
    return features[:, (place_down**2 + place_across**2).sqrt() < 0.12 * rows]


ENCODER = ImageDescriptors(color_scales=(2.0, 8.0), texture_scales=(4.0, 8.0))


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_quarter_turn_of_the_image_turns_the_map_alone(quarters):
    image = picture()
    found = ENCODER.describe(torch.rot90(image, quarters, (0, 1)))
    expected = torch.rot90(ENCODER.describe(image), quarters, (1, 2))
    # Sums run in another order, in float32, and curvatures magnify their rounding (1e-7) by some thousands. In the
    # outermost cells it matters which derivative comes first.
    inside = slice(1, -1)
    torch.testing.assert_close(found[:, inside, inside], expected[:, inside, inside], rtol=0, atol=5e-3)


def test_a_picture_in_more_pixels_is_described_alike():
    coarse, fine = ENCODER.describe(picture(256)), ENCODER.describe(picture(512))
    assert coarse.shape == fine.shape == (26, 128, 128)
    # Waves of 12 pixels or more, averaged over two by two finer pixels; features are of about unit size.
    assert float((coarse - fine).abs().mean()) < 0.02


def test_features_lie_where_the_image_shows_them():
    # A red patch: its center of mass in the map, as shares of the image, is its own.
    image = torch.zeros(200, 120, 3)
    image[60:100, 20:50, 0] = 1.0
    found = ENCODER.describe(image)
    redness = (found[1] - found[1].min()).double()
    rows = (torch.arange(redness.shape[0]) + 0.5) / redness.shape[0]
    columns = (torch.arange(redness.shape[1]) + 0.5) / redness.shape[1]
    assert found.shape[1:] == (128, 77)
    # A quarter of the patch's own pixel; half a cell would be .8 pixels.
    assert float((redness.sum(1) * rows).sum() / redness.sum()) * 200 == pytest.approx(80, abs=0.25)
    assert float((redness.sum(0) * columns).sum() / redness.sum()) * 120 == pytest.approx(35, abs=0.25)


def test_descriptors_tell_what_they_are_made_to_tell():
    plain = torch.full((256, 256, 3), 0.5)
    stripes = plain.clone()
    stripes[:, ::8] = 0.8
    checks = plain.clone()
    checks[:, ::8] = checks[::8] = 0.8
    first = (
        ENCODER.describe(plain)[:, 64, 64],
        ENCODER.describe(stripes)[:, 64, 64],
        ENCODER.describe(checks)[:, 64, 64],
    )
    flat, lined, crossed = (dict(zip(NAMES, each[6:18].tolist(), strict=True)) for each in first)
    # Nothing varies on a plain gray: no gradient, no orientation, no spread, no curvature.
    assert all(abs(value) < 1e-2 for value in flat.values())
    # Stripes have one orientation (both signs of it: no first coefficient), checks two at right angles: no second.
    assert lined["second"] > 5
    assert lined["first"] < 0.2 * lined["second"]
    assert crossed["fourth"] > 1
    assert crossed["second"] < 0.1 * crossed["fourth"]
    assert crossed["gradient"] > lined["gradient"] > 1
