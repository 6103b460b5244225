"""CDPAM beside the authors' own modules, its cache of embeddings, and weights that are not what they should be."""

import importlib.util
import math
from pathlib import Path

import pytest
import torch
from torch.nn.functional import conv1d

from avmsf.errors import EvaluationError
from avmsf.evaluation.cdpam import Cdpam, find_weights, read_weights
from factories.raising import raises

RATE = 22050.0
needs_weights = pytest.mark.skipif(importlib.util.find_spec("cdpam") is None, reason="needs pip install 'avmsf[eval]'")


@pytest.fixture(scope="module")
def cdpam() -> Cdpam:
    return Cdpam.load()


@pytest.fixture(scope="module")
def authors_model() -> torch.nn.Module:
    """The network of the package's own classes in float64; the module beside it, which imports more, stays asleep."""
    found = importlib.util.spec_from_file_location("cdpam_models", find_weights().parents[1] / "models.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    model = module.FINnet(encoder_layers=16, encoder_filters=64, input_size=512, classif_BN=0)
    model.load_state_dict(dict(read_weights(find_weights())))
    return model.eval().double()


def strikes(samples: int, *, level: float = 0.5) -> torch.Tensor:
    """Two decaying chords and a noise, as float32 holds them."""
    times = torch.arange(samples, dtype=torch.float64) / RATE
    chord = torch.stack([torch.sin(2 * math.pi * pitch * times) for pitch in (440.0, 1210.0, 2990.0)])
    mixes = torch.tensor([[1.0, 0.5, 0.25], [0.3, -0.9, 0.6]], dtype=torch.float64)
    sounds = torch.exp(-30 * times) * (mixes @ chord) / 2
    noise = 0.3 * torch.randn(1, samples, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return (level * torch.cat([sounds, noise])).float().double()


@torch.inference_mode()
def authors_distance(model: torch.nn.Module, sounds: torch.Tensor) -> torch.Tensor:
    """Distance of each sound from the one before it, cyclically."""
    heard = torch.nn.functional.normalize(model.base_encoder(sounds[:, None])[1], dim=1)
    return model.model_dist(heard, heard.roll(1, dims=0))


# 300 samples are near the ends all of them; of 1150 the middle is not. Faint sounds are where rounding would be heard:
# the authors' own float32 is 8 % off at a level of .1.
@needs_weights
@pytest.mark.parametrize(("samples", "level"), [(300, 0.5), (1150, 0.02)])
def test_distances_are_those_of_the_authors_modules(cdpam, authors_model, samples, level):
    sounds = strikes(samples, level=level)[[0, 2]]
    others = sounds.roll(1, dims=0)
    found = cdpam.distance(sounds, others, sample_rate=RATE)
    assert torch.allclose(found, authors_distance(authors_model, sounds), rtol=1e-3, atol=0.0)
    sounds, others = (torch.round(32768 * each) for each in (sounds, others))
    found = cdpam.distance(sounds, others, sample_rate=RATE)
    assert torch.allclose(found, authors_distance(authors_model, sounds), rtol=1e-4)


@needs_weights
def test_a_few_samples_have_a_distance(cdpam):
    for samples in (1, 9):
        assert bool(torch.isfinite(cdpam.distance(strikes(samples), 0 * strikes(samples), sample_rate=RATE)).all())


@needs_weights
def test_a_sound_is_embedded_once(cdpam, monkeypatch):
    sounds, asked = strikes(200), []
    expected = cdpam.embed(sounds, sample_rate=RATE)
    monkeypatch.setattr(
        "avmsf.evaluation.cdpam.conv1d", lambda *given, **named: asked.append(given) or conv1d(*given, **named)
    )
    assert torch.equal(cdpam.embed(sounds.flip(0), sample_rate=RATE), expected.flip(0))
    assert asked == []
    for others in ((0.9 * sounds, RATE), (sounds, 22051.0)):
        asked.clear()
        cdpam.embed(others[0], sample_rate=others[1])
        assert asked


@needs_weights
def test_sounds_that_cannot_be_compared_are_refused(cdpam):
    good = strikes(500)
    with raises(EvaluationError, name="sounds", row=2):
        cdpam.embed(good / torch.tensor([[1.0], [1.0], [0.0]]), sample_rate=RATE)
    with raises(EvaluationError, name="sounds", value=[500]):
        cdpam.embed(good[0], sample_rate=RATE)
    for rate in (0.0, -1.0, math.nan, 10.0):
        with raises(EvaluationError, name="sample_rate") as caught:
            cdpam.embed(good, sample_rate=rate)
        assert caught.value.value is rate
    with raises(EvaluationError, name="sounds", row=None) as caught:
        cdpam.embed(1e308 * good, sample_rate=RATE)
    assert 1e307 < caught.value.value <= 1e308


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with raises(EvaluationError, name="cdpam"):
        Cdpam.load()


def test_other_weights_are_refused_unread(tmp_path):
    class Touch:
        def __reduce__(self):
            return Path.touch, (tmp_path / "touched",)

    path = tmp_path / "weights.pth"
    for write in (lambda: None, lambda: torch.save({"state": Touch()}, path)):
        write()
        with raises(EvaluationError, file=path, name=None):
            read_weights(path)
    assert not (tmp_path / "touched").exists()
