"""DINOv2 as an encoder, on tiny random models of its classes: the map is the model's own tokens, in their places."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from avmsf.errors import SceneError
from avmsf.features.dino import MODELS, DinoEncoder
from factories.raising import raises

transformers = pytest.importorskip("transformers")
PATCH = 14
PREPROCESSOR = "preprocessor_config.json"


def tiny(registers: bool) -> torch.nn.Module:
    """A random model of DINOv2's architecture, sixteen features wide."""
    sizes = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 4 * PATCH}
    torch.manual_seed(0)
    if registers:
        config = transformers.Dinov2WithRegistersConfig(patch_size=PATCH, initializer_range=0.3, **sizes)
        return transformers.Dinov2WithRegistersModel(config).eval()
    return transformers.Dinov2Model(transformers.Dinov2Config(patch_size=PATCH, initializer_range=0.3, **sizes)).eval()


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "registers"])
def folder(request, tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("model") / "tiny"
    tiny(request.param).save_pretrained(place)
    record = {"image_mean": [0.4, 0.5, 0.6], "image_std": [0.2, 0.3, 0.1]}
    (place / PREPROCESSOR).write_text(json.dumps(record))
    return place


def load(folder: Path, **settings) -> DinoEncoder:
    return DinoEncoder.load(folder, **{"longest": None, **settings})


def image(height: int, width: int) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1))


def own_tokens(encoder: DinoEncoder, picture: torch.Tensor) -> torch.Tensor:
    """The model's hidden states on a picture of whole patches, class and register tokens dropped."""
    normal = (picture - torch.tensor([0.4, 0.5, 0.6])) / torch.tensor([0.2, 0.3, 0.1])
    with torch.no_grad():
        states = encoder.model(pixel_values=normal.permute(2, 0, 1)[None]).last_hidden_state[0]
    extra = 1 + getattr(encoder.model.config, "num_register_tokens", 0)
    rows, columns = picture.shape[0] // PATCH, picture.shape[1] // PATCH
    assert len(states) == extra + rows * columns
    return states[extra:].reshape(rows, columns, -1).permute(2, 0, 1)


@pytest.mark.parametrize(("height", "width"), [(56, 56), (42, 98), (14, 14), (43, 70), (29, 55), (5, 90), (71, 13)])
def test_the_map_is_the_models_own_grid_of_any_size_in_its_place(folder, height, width):
    encoder, picture = load(folder), image(height, width)
    assert encoder.name == "DINOv2 from the folder tiny"
    found = encoder.describe(picture)
    rows, columns = -(-height // PATCH), -(-width // PATCH)
    # Continued by hand: the last row and column again and again.
    down = torch.arange(rows * PATCH).clamp(max=height - 1)
    across = torch.arange(columns * PATCH).clamp(max=width - 1)
    tokens = own_tokens(encoder, picture[down][:, across]).double()
    assert found.shape == tokens.shape
    # Equal cells of the image proper have their middles elsewhere than the patches of the continued one.
    y = ((torch.arange(rows) + 0.5) * height / rows).double()
    x = ((torch.arange(columns) + 0.5) * width / columns).double()
    y, x = 2 * y / (rows * PATCH) - 1, 2 * x / (columns * PATCH) - 1
    grid = torch.stack([x[None, :].expand(rows, columns), y[:, None].expand(rows, columns)], dim=-1)[None]
    expected = torch.nn.functional.grid_sample(tokens[None], grid, align_corners=False, padding_mode="border")[0]
    torch.testing.assert_close(found, expected.float(), rtol=0, atol=1e-4)


def test_longest_sets_the_resolution_and_keeps_the_proportions(folder):
    assert load(folder, longest=56).describe(image(100, 200)).shape == (16, 2, 4)
    assert load(folder, longest=70).describe(image(20, 10)).shape == (16, 5, 3)
    with raises(SceneError, name="longest", value=0):
        load(folder, longest=0)


def test_without_constants_of_its_own_a_model_gets_imagenets(folder, tmp_path):
    bare = Path(shutil.copytree(folder, tmp_path / "bare"))
    (bare / PREPROCESSOR).unlink()
    picture = image(28, 28)
    # What ImageNet's constants make of it, for the model with the other constants.
    usual = (picture - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])
    expected = own_tokens(load(folder), usual * torch.tensor([0.2, 0.3, 0.1]) + torch.tensor([0.4, 0.5, 0.6]))
    torch.testing.assert_close(load(bare).describe(picture), expected, rtol=0, atol=1e-4)


def test_without_network_one_error_says_what_to_put_where(tmp_path, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    # A port that nobody listens at.
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr("huggingface_hub.hf_api.api.endpoint", "http://127.0.0.1:9")
    for offline in (False, True):
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", offline)
        with raises(SceneError, name="encoder", value=MODELS[0]):
            DinoEncoder.load(MODELS[0])


def change(folder: Path, **settings) -> None:
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | settings))


@pytest.mark.parametrize(
    ("damage", "file", "name"),
    [
        (shutil.rmtree, "copy", "encoder"),
        (lambda at: (at / "config.json").unlink(), "copy", "config.json"),
        (lambda at: (at / "model.safetensors").unlink(), "copy", "model.safetensors"),
        (lambda at: (at / "config.json").write_text("{"), None, None),
        (lambda at: (at / "config.json").write_text("[]"), None, None),
        (lambda at: change(at, model_type="vit"), "config.json", "model_type"),
        (lambda at: change(at, model_type=[]), "config.json", "model_type"),
        (lambda at: (at / "model.safetensors").write_bytes(b"half"), "model.safetensors", None),
        (lambda at: change(at, hidden_size=32), "model.safetensors", None),
        (lambda at: change(at, num_hidden_layers=3), "model.safetensors", ".layer.2."),
        (lambda at: (at / PREPROCESSOR).write_text('{"image_mean": [1]}'), PREPROCESSOR, "image_mean"),
    ],
)
def test_a_folder_that_is_no_model_is_refused(folder, tmp_path, damage, file, name):
    damage(copy := Path(shutil.copytree(folder, tmp_path / "copy")))
    with raises(SceneError, file=file) as caught:
        load(copy)
    assert (name or "") in (caught.value.name or "")
