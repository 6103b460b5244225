"""The published SonicGauss: its names of tensors, its curves and sparse convolution, and a tiny copy on disk."""

from dataclasses import replace
from functools import cache
from itertools import product

import pytest
import torch
from safetensors.torch import load_file, save_file

from avmsf.baselines.sonicgauss import published
from avmsf.baselines.sonicgauss.conditioning import first_nine, normalized
from avmsf.baselines.sonicgauss.point_transformer import (
    EncoderSizes,
    PointEncoder,
    SerializedAttention,
    SubmanifoldConvolution,
    Voxels,
    hilbert,
    z_order,
)
from avmsf.baselines.sonicgauss.published import PublishedSizes, PublishedSonicGauss, fit_published
from avmsf.errors import EvaluationError
from avmsf.evaluation.methods import method_named
from factories.clouds import cloud, impacts
from factories.raising import raises

pytest.importorskip("diffusers")

FLUX = {"num_layers": 1, "num_single_layers": 1, "attention_head_dim": 16, "num_attention_heads": 2}
FLUX |= {"in_channels": 8, "axes_dims_rope": (4, 6, 6)}
CODER = {"encoder_hidden_size": 16, "downsampling_ratios": [2, 4], "channel_multiples": [1, 2]}
CODER |= {"decoder_channels": 8, "decoder_input_channels": 8, "audio_channels": 2, "sampling_rate": 8000}
ENCODER = EncoderSizes((8, 8, 16), (1, 2, 1), (2, 2, 4), (2, 4), 32)
TINY = PublishedSizes(ENCODER, width=32, contact=(16, 16), fusion_heads=4, transformer=FLUX, autoencoder=CODER)


@cache
def model() -> PublishedSonicGauss:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return PublishedSonicGauss(TINY).eval().requires_grad_(False)


@pytest.fixture
def folder(tmp_path):
    """Return a folder with the tiny model's weights, and with what the published files hold besides."""
    for name, part in model().files().items():
        tensors = {each: value.clone() for each, value in part.state_dict().items()}
        if name == "model_1.safetensors":
            tensors["text_encoder.shared.weight"] = torch.zeros(2)
        if name == "model_2.safetensors":
            tensors["feature_predictor.backbone.backbone.dec.dec0.up.proj.0.weight"] = torch.zeros(2)
            tensors["feature_predictor.features_outputhead.means.0.bias"] = torch.zeros(2)
        save_file(tensors, tmp_path / name)
    return tmp_path


def test_tensors_have_the_published_names_and_sizes():
    with torch.device("meta"):
        encoder = PointEncoder(23, EncoderSizes())
    shapes = {name: tuple(value.shape) for name, value in encoder.state_dict().items()}
    # As Point Transformer V3 in SplatFormer's configuration names them.
    assert shapes["embedding.0.weight"] == (64, 23)
    assert shapes["embedding.1.running_var"] == (64,)
    assert shapes["enc.enc0.block1.cpe.0.weight"] == (64, 3, 3, 3, 64)
    assert shapes["enc.enc1.down.proj.weight"] == (96, 64)
    assert shapes["enc.enc1.down.norm.0.running_mean"] == (96,)
    assert shapes["enc.enc3.block5.attn.qkv.weight"] == (768, 256)
    assert shapes["enc.enc4.block1.cpe.2.bias"] == (512,)
    assert shapes["enc.enc4.block0.norm1.0.weight"] == (512,)
    assert shapes["enc.enc4.block0.mlp.0.fc1.weight"] == (2048, 512)
    names = {file: set(part.state_dict()) for file, part in model().files().items()}
    assert {"fc.0.weight", "duration_emebdder.time_positional_embedding.0.weights"} < names["model_1.safetensors"]
    assert "transformer.single_transformer_blocks.0.proj_mlp.weight" in names["model_1.safetensors"]
    assert "feature_predictor.backbone.backbone.enc.enc0.block0.attn.proj.weight" in names["model_2.safetensors"]
    assert {"projection.weight", "projection.bias"} < names["model_2.safetensors"]
    assert names["model_3.safetensors"] == {
        "freqs",
        *(f"mlp.{row}.{each}" for row in (0, 2, 4) for each in ("weight", "bias")),
    }
    assert {"cross_attn.in_proj_weight", "norm2.bias", "ffn.3.weight"} < names["model_4.safetensors"]


def test_a_folder_of_weights_is_read_whole(folder):
    loaded = PublishedSonicGauss.load(folder, TINY)
    for (name, one), (other_name, other) in zip(loaded.state_dict().items(), model().state_dict().items(), strict=True):
        assert name == other_name
        assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("model_1.safetensors", "transformer.x_embedder.weight"),
        ("model_2.safetensors", "feature_predictor.backbone.backbone.enc.enc1.down.norm.0.running_mean"),
        ("model_4.safetensors", "ffn.3.bias"),
    ],
)
def test_missing_tensors_other_shapes_and_other_models_are_refused_by_name(folder, file, name):
    whole = load_file(folder / file)
    lacking = {each: value for each, value in whole.items() if each != name}
    other = "unet.down.weight"
    for tensors, named in (
        (lacking, name),
        ({**whole, name: torch.zeros(3, 2)}, name),
        ({**whole, other: torch.zeros(1)}, other),
    ):
        save_file(tensors, folder / file)
        with raises(EvaluationError, file=folder / file) as caught:
            PublishedSonicGauss.load(folder, TINY)
        assert named in str(caught.value)


def test_missing_and_damaged_files_are_refused_by_name(folder):
    path = folder / "model_3.safetensors"
    for damage in (lambda: path.write_bytes(b"no weights"), path.unlink):
        damage()
        with raises(EvaluationError, file=path):
            PublishedSonicGauss.load(folder, TINY)


def grid(side: int) -> torch.Tensor:
    return torch.tensor(list(product(range(side), repeat=3)))


def test_hilberts_curve_fills_the_cube_in_steps_of_one():
    codes = hilbert(grid(8), 3)
    assert sorted(codes.tolist()) == list(range(512))
    path = grid(8)[codes.argsort()]
    assert bool(((path[1:] - path[:-1]).abs().sum(1) == 1).all())
    # Each eighth of the cube is a whole eighth of the curve.
    assert len(torch.unique(torch.stack([codes >> 6, z_order(grid(8), 3) >> 6]), dim=1).T) == 8


def test_z_order_interleaves_bits_from_x_on():
    places = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [3, 5, 1]])
    assert z_order(places, 3).tolist() == [4, 2, 1, 32, 0b010100111]


def test_sparse_convolution_is_the_dense_one_at_occupied_voxels():
    places = grid(4)[torch.randperm(64, generator=torch.Generator().manual_seed(0))[:30]]
    voxels = Voxels(places, torch.zeros(4, 30, dtype=torch.int64))
    convolution = SubmanifoldConvolution(3)
    features = torch.randn(30, 3)
    dense = torch.zeros(1, 3, 4, 4, 4)
    dense[0, :, places[:, 0], places[:, 1], places[:, 2]] = features.T
    wanted = torch.nn.functional.conv3d(dense, convolution.weight.permute(0, 4, 1, 2, 3), convolution.bias, padding=1)
    torch.testing.assert_close(
        convolution(features, voxels), wanted[0, :, places[:, 0], places[:, 1], places[:, 2]].T, rtol=1e-4, atol=1e-5
    )


def test_attention_in_one_patch_is_attention_among_all_points_in_any_order():
    attention = SerializedAttention(8, 2, patch=64)
    features = torch.randn(40, 8)
    order = torch.randperm(40)
    straight = attention(features, torch.arange(40))
    torch.testing.assert_close(attention(features, order), straight, rtol=1e-4, atol=1e-5)
    attention.patch = 16
    # Points of the first patch know nothing of others; the last patch reaches back for as many as it lacks.
    patched = attention(features, torch.arange(40))
    torch.testing.assert_close(patched[:16], attention(features[:16], torch.arange(16)), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(patched[32:], attention(features[24:], torch.arange(16))[8:], rtol=1e-4, atol=1e-5)


def test_pooling_takes_the_largest_of_each_coarser_voxel():
    voxels = Voxels.of(grid(4) / 384 + 1e-4)
    coarse, cluster = voxels.coarser(2)
    assert len(coarse.places) == 8
    assert torch.equal(coarse.places[cluster], grid(4) // 2)
    again, _ = Voxels.of(grid(4) / 384 + 1e-4).coarser(4)
    assert again.places.tolist() == [[0, 0, 0]]


def test_the_order_of_gaussians_changes_nothing():
    one = cloud(60, degree=3)
    other = one.take(torch.randperm(60, generator=torch.Generator().manual_seed(0)))
    tokens = [model().gaussians(normalized(each, first_nine(each))) for each in (one, other)]
    assert tokens[0].shape == (1, 64, 32)
    torch.testing.assert_close(tokens[0], tokens[1], rtol=1e-4, atol=1e-4)


def test_contact_object_duration_and_dropped_conditions_change_the_velocity():
    one, other = (normalized(each, first_nine(each)) for each in (cloud(60), cloud(60, seed=1)))
    latents, times, place = torch.randn(1, 64, 8), torch.tensor([0.4]), torch.rand(1, 3)
    tokens = model().condition(model().gaussians(one), place)
    base = model().velocity(latents, times, tokens, seconds=1.0)
    for changed in (
        model().velocity(latents, times, model().condition(model().gaussians(one), place + 0.3), seconds=1.0),
        model().velocity(latents, times, model().condition(model().gaussians(other), place), seconds=1.0),
        model().velocity(latents, times, tokens, seconds=2.5),
        model().velocity(latents, times, tokens, seconds=1.0, kept=torch.zeros(1, 1, 1)),
        model().velocity(latents, times + 0.2, tokens, seconds=1.0),
    ):
        assert not torch.allclose(changed, base, rtol=0, atol=1e-5)


def test_it_fits_and_renders_from_a_folder_by_its_seed(folder, monkeypatch):
    monkeypatch.setattr(published, "EPOCHS", 2)
    first, again = (
        replace(fit_published(PublishedSonicGauss.load(folder, TINY), cloud(60), impacts(3)), steps=2) for _ in range(2)
    )
    contacts = impacts(3).contacts
    sounds = first.render(contacts)
    assert sounds.shape == impacts(3).sounds.shape
    assert torch.equal(again.render(contacts), sounds)
    assert torch.equal(first.render(contacts[1:2])[0], sounds[1])


def test_results_of_other_weights_are_not_mixed(folder):
    method = method_named(f"sonicgauss:{folder}")
    assert method.name == f"sonicgauss:{folder}"
    (folder / "model_3.safetensors").write_bytes(b"others")
    assert repr(method_named(f"sonicgauss:{folder}")) != repr(method)
    # Gigabytes, as the published ones have, are not read whole at every start.
    with open(folder / "large.safetensors", "wb") as file:
        file.truncate(1 << 38)
    assert repr(method_named(f"sonicgauss:{folder}")) != repr(method)
    for name in ("sonicgauss:/nowhere", "sonicgauss"):
        with pytest.raises(EvaluationError):
            method_named(name)
