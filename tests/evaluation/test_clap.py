"""The CLAP score beside a direct use of the model, and folders that hold something else."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from avmsf.errors import EvaluationError
from avmsf.evaluation.clap import Clap
from factories.made_clap import RATE, SECONDS, save_clap
from factories.raising import raises

pytest.importorskip("transformers", reason="needs pip install 'avmsf[eval]'")
CLIP = round(SECONDS * RATE)
PROMPTS = ("a blow on wood", "a bright metal bell", "glass")


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clap")
    save_clap(folder)
    return folder


@pytest.fixture(scope="module")
def clap(saved) -> Clap:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_OFFLINE", "1")
        return Clap.load(saved)


def strikes(count: int = 3, *, samples: int = 24000, rate: float = RATE) -> torch.Tensor:
    times = torch.arange(samples, dtype=torch.float64) / rate
    pitches = 400.0 * torch.arange(1, count + 1, dtype=torch.float64) ** 2
    sines = torch.sin(2 * math.pi * torch.outer(pitches, times))
    return 0.5 * torch.exp(-torch.outer(5 * torch.arange(1, count + 1), times)) * sines


def directly(clap: Clap, sounds: torch.Tensor, prompts: tuple[str, ...]) -> torch.Tensor:
    """The cosines by the model's own methods, for sounds of peak one at its own rate that fill its clip."""
    heard = clap.processor.feature_extractor(list(sounds.numpy()), sampling_rate=int(RATE), return_tensors="pt")
    said = clap.processor.tokenizer(list(prompts), return_tensors="pt", padding=True)
    with torch.no_grad():
        audio = clap.model.get_audio_features(**heard).pooler_output
        text = clap.model.get_text_features(**said).pooler_output
    return torch.nn.functional.cosine_similarity(audio, text).double()


def test_the_score_is_the_models_own_cosine(clap):
    sounds = strikes(samples=CLIP)
    sounds = sounds / sounds.abs().amax(dim=1, keepdim=True)
    found = torch.cat([clap.score(sounds[[row]], PROMPTS[row], sample_rate=RATE) for row in range(3)])
    expected = directly(clap, sounds, PROMPTS)
    # A random network: the cosines have to differ for their equality to say anything.
    assert float(expected.max() - expected.min()) > 0.01
    assert torch.allclose(found, expected, rtol=0.0, atol=1e-5)
    assert bool((found.abs() <= 1.0).all())


def test_level_does_not_matter_and_the_sample_rate_hardly(clap):
    expected = clap.embed(strikes(), sample_rate=RATE)
    assert torch.allclose(clap.embed(0.01 * strikes(), sample_rate=RATE), expected, rtol=0.0, atol=1e-5)
    half = clap.embed(strikes(samples=12000, rate=24000.0), sample_rate=24000.0)
    others = (half @ expected.T).diagonal()
    assert float(others.min()) > 0.999
    # Where the rate is not heeded the pitch is another: that is heard.
    assert float((clap.embed(strikes(), sample_rate=24000.0) * expected).sum(dim=1).min()) < 0.999


def test_a_batch_is_its_sounds_one_by_one(clap):
    sounds = strikes(11, samples=6000)
    expected = torch.cat([clap.embed(sound[None], sample_rate=RATE) for sound in sounds])
    assert torch.allclose(clap.embed(sounds, sample_rate=RATE), expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("fused", [False, True])
def test_longer_sounds_are_cut_at_the_same_place_every_time(tmp_path, fused):
    save_clap(tmp_path, fused=fused)
    network, sounds, found = Clap.load(tmp_path), strikes(2, samples=3 * CLIP), []
    for given in (sounds, sounds, sounds, sounds[:, :CLIP]):
        np.random.seed(len(found))
        found.append(network.embed(given, sample_rate=RATE))
    assert all(torch.equal(each, found[0]) for each in found)


def test_sounds_and_prompts_that_cannot_be_scored_are_refused(clap):
    for prompt in ("", "  "):
        with raises(EvaluationError, name="prompt", value=prompt):
            clap.score(strikes(), prompt, sample_rate=RATE)
    silent = strikes()
    silent[1] = 0.0
    with raises(EvaluationError, name="sounds", row=1, value=0.0):
        clap.embed(silent, sample_rate=RATE)


def test_folders_that_hold_something_else_are_named(saved, tmp_path):
    with raises(EvaluationError, file=tmp_path, name="source"):
        Clap.load(tmp_path)
    other = tmp_path / "other"
    shutil.copytree(saved, other)
    whole = (other / "model.safetensors").read_bytes()
    (other / "model.safetensors").write_bytes(whole[:1000])
    with raises(EvaluationError, file=other, name="source"):
        Clap.load(other)
    (other / "model.safetensors").write_bytes(whole)
    (other / "config.json").write_text(json.dumps({"model_type": "bert"}), encoding="utf-8")
    with pytest.raises(EvaluationError):
        Clap.load(other)


def test_weights_that_are_not_there_are_not_made_up(saved, tmp_path):
    from safetensors.torch import load_file, save_file

    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    weights = load_file(tmp_path / "model.safetensors")
    weights.pop("audio_projection.linear1.weight")
    save_file(weights, tmp_path / "model.safetensors", {"format": "pt"})
    missing = ("audio_projection.linear1.weight",)
    with raises(EvaluationError, file=tmp_path, name="weights", value=missing):
        Clap.load(tmp_path)
