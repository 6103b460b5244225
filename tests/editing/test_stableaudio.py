"""Stable Audio's classes with tiny random weights, saved and loaded as a user's folder would be."""

import math
import shutil
import warnings
from pathlib import Path

import pytest
import torch

from avmsf.editing.config import STABLE_AUDIO
from avmsf.editing.stable_audio import StableAudio
from avmsf.errors import EditError
from factories.made_audio import DIM, FRAMES, RATE, save_audio, tiny_pipeline
from factories.raising import raises

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    diffusers = pytest.importorskip("diffusers")
    pytest.importorskip("transformers")
    from diffusers import StableAudioPipeline

pytestmark = pytest.mark.filterwarnings("ignore:`torch.nn.utils.weight_norm` is deprecated:FutureWarning")


@pytest.fixture(autouse=True)
def offline(monkeypatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return save_audio(tmp_path_factory.mktemp("model") / "tiny-audio")


@pytest.fixture(scope="module")
def model(folder) -> StableAudio:
    return StableAudio.load(folder, device="cpu")


def some_latents(count: int = 2) -> torch.Tensor:
    return torch.randn(count, DIM // 2, FRAMES, generator=torch.Generator().manual_seed(1))


def test_a_folder_is_loaded_and_frozen(model):
    assert (model.name, model.sample_rate, model.channels) == ("tiny-audio", RATE, 2)
    assert (model.device.type, model.dtype) == ("cpu", torch.float32)
    networks = (model.pipeline.vae, model.pipeline.transformer, model.pipeline.text_encoder)
    assert not any(weight.requires_grad for network in networks for weight in network.parameters())
    # Models of one name are told apart by their weights.
    same, other = (StableAudio(tiny_pipeline(), name="tiny-audio") for _ in range(2))
    with torch.no_grad():
        other.pipeline.transformer.proj_in.weight[0, 0] += 1e-3
    assert same.describe() == model.describe() != other.describe()


def test_only_what_sounds_is_encoded_and_decoded(model):
    sounds = torch.randn(2, 2, 1600, generator=torch.Generator().manual_seed(2))
    found = model.encode(sounds)
    padded = torch.nn.functional.pad(sounds, (0, FRAMES * 8 - 1600))
    with torch.no_grad():
        whole = model.pipeline.vae.encode(padded).latent_dist.mode()
    assert found.shape == whole.shape
    # The window's own end is heard by the last frames alone.
    torch.testing.assert_close(found[:, :, : FRAMES - 60], whole[:, :, : FRAMES - 60], rtol=0, atol=1e-5)
    with torch.no_grad():
        decoded = model.pipeline.vae.decode(some_latents()).sample
    torch.testing.assert_close(model.decode(some_latents(), samples=1001), decoded[:, :, :1001], rtol=0, atol=1e-5)


def test_the_estimate_is_the_v_prediction_of_the_paper(model):
    # In the latents cos(a) z + sin(a) noise the network says v, and z = cos(a) noisy - sin(a) v; its time is t itself.
    latents, level = some_latents(), torch.tensor([0.2, 0.7])
    conditioning = model.embed("wood", seconds=0.4)
    angle = (0.5 * math.pi * level)[:, None, None]
    rotary = diffusers.models.embeddings.get_1d_rotary_pos_embed(
        4, FRAMES + 1, use_real=True, repeat_interleave_real=False
    )
    text, times = (each[1:].expand(2, -1, -1) for each in (conditioning.text, conditioning.times))
    given = {"encoder_hidden_states": text, "global_hidden_states": times, "rotary_embedding": rotary}
    with torch.no_grad():
        v = model.pipeline.transformer(latents, level, return_dict=False, **given)[0]
    found = model.denoised(latents, level, conditioning, guidance=1.0)
    torch.testing.assert_close(found, torch.cos(angle) * latents - torch.sin(angle) * v, rtol=1e-4, atol=1e-5)
    # Guidance is linear in the text.
    without, strong = (model.denoised(latents, level, conditioning, guidance=each) for each in (0.0, 7.0))
    torch.testing.assert_close(strong, without + 7 * (found - without), rtol=1e-3, atol=1e-4)
    assert float((found - without).abs().max()) > 1e-4


def test_words_are_embedded_as_the_pipeline_does(model):
    plain = model.embed("wood", seconds=0.4)
    assert not bool(plain.text[0].any())
    words = model.pipeline.encode_prompt("wood", model.device, False)
    torch.testing.assert_close(plain.text[1, :-2], words[0])
    assert not torch.allclose(plain.times, model.embed("wood", seconds=4.0).times)


def test_a_sound_from_words_alone(model):
    one, other = (model.generate("wood", seconds=0.3, seed=seed, steps=3) for seed in (1, 2))
    assert one.shape == (round(0.3 * RATE),)
    assert not torch.allclose(one, other)


@pytest.mark.parametrize(
    ("prompt", "seconds", "name"), [(" ", 0.3, "prompt"), *(("wood", s, "seconds") for s in (0.6, 0.0))]
)
def test_sounds_that_cannot_be_made_are_refused(model, prompt, seconds, name):
    with raises(EditError, name=name, value=prompt if name == "prompt" else seconds):
        model.generate(prompt, seconds=seconds, seed=0)


def test_models_that_cannot_be_used_are_refused(model, folder, monkeypatch):
    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    with raises(EditError, name="device", value="gpu"):
        StableAudio.load(folder, device="gpu")
    monkeypatch.setattr(model.pipeline.transformer, "forward", full)
    with raises(EditError, name="device", value="cpu"):
        model.generate("wood", seconds=0.3, seed=0, steps=2)
    monkeypatch.setattr(StableAudioPipeline, "to", full)
    with raises(EditError, name="device", value="cpu"):
        StableAudio.load(folder, device="cpu")
    monkeypatch.setattr("avmsf.editing.stable_audio.find_spec", lambda name: None)
    with raises(EditError, name="diffusers"):
        StableAudio.load(folder)


def test_seconds_bound_the_window(folder):
    short = StableAudio.load(folder, seconds=0.25, device="cpu")
    assert short.describe()["frames"] == 250
    assert short.encode(torch.zeros(1, 2, 1600)).shape[2] == 250
    with raises(EditError, name="seconds", value=0.5):
        short.encode(torch.zeros(1, 2, 4000))
    with raises(EditError, name="seconds", value=1.0):
        StableAudio.load(folder, seconds=1.0, device="cpu")


def test_weights_that_are_not_here(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with raises(EditError, name="source", value=STABLE_AUDIO):
        StableAudio.load()
    with raises(EditError, file=tmp_path / "nowhere", name="source"):
        StableAudio.load(tmp_path / "nowhere")


def test_a_folder_that_is_not_complete(folder, tmp_path):
    from safetensors.torch import load_file, save_file

    place = Path(shutil.copytree(folder, tmp_path / "copy"))
    path = place / "transformer" / "diffusion_pytorch_model.safetensors"
    weights = load_file(path)
    save_file({name: each for name, each in weights.items() if name != "proj_in.weight"}, path)
    spoilers = (
        lambda: None,
        lambda: path.write_bytes(b"broken"),
        path.unlink,
        lambda: shutil.rmtree(place / "vae"),
        lambda: (place / "model_index.json").write_text("{"),
        (place / "model_index.json").unlink,
    )
    for spoil in spoilers:
        spoil()
        with raises(EditError, file=place, name="source"):
            StableAudio.load(place)
