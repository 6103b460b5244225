"""Distilling a diffusion model into targets, on models whose every answer is known."""

import math
from dataclasses import dataclass, field

import pytest
import torch

from avmsf.editing.config import DistillationConfig
from avmsf.editing.distillation import DecoderDistillation, noised, partial_denoising
from avmsf.errors import EditError
from avmsf.modal.spectra import levelled
from factories.raising import raises
from factories.ringing_field import RATE, ringing_field, sound_of

HOP = 8


@dataclass
class Known:
    """A model whose latents are the waveform in rows of eight, and which knows what it wants to hear.

    Without words it sees the noisy latents' own share, with words so much of `wanted` on top.
    """

    wanted: torch.Tensor | None = None
    sample_rate: float = RATE
    room: int = 1000
    """Most sounds that its memory holds."""
    name: str = "known"
    channels: int = 2
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    dtype: torch.dtype = torch.float32
    asked: list = field(default_factory=list)

    def describe(self):
        return {"room": self.room}

    def encode(self, waveforms):
        if len(waveforms) > self.room:
            raise torch.OutOfMemoryError("CUDA out of memory")
        assert waveforms.shape[1] == 2
        mono = waveforms.mean(1)
        return torch.nn.functional.pad(mono, (0, -mono.shape[1] % HOP)).reshape(len(mono), -1, HOP).mT

    def decode(self, latents, *, samples):
        return latents.mT.flatten(1)[:, None, :samples].expand(-1, 2, -1)

    def embed(self, prompt, *, seconds):
        self.asked.append((prompt, seconds))
        return prompt

    def denoised(self, latents, level, conditioning, *, guidance):
        without = torch.cos(0.5 * math.pi * level)[:, None, None] * latents
        if self.wanted is None:
            return without
        wanted = self.encode(self.wanted.expand(len(latents), -1)[:, None].expand(-1, 2, -1))
        return without + guidance * (wanted - without)


class Gaussian(Known):
    """The best denoiser of data of independent normal numbers of deviation `scale`."""

    scale = 0.3

    def denoised(self, latents, level, conditioning, *, guidance):
        angle = (0.5 * math.pi * level)[:, None, None]
        spread = (self.scale * torch.cos(angle)).square() + torch.sin(angle).square()
        return self.scale**2 * torch.cos(angle) / spread * latents


def guide(model, **settings) -> DecoderDistillation:
    return DecoderDistillation(model, "wood", sample_rate=RATE, config=DistillationConfig(**settings))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_noise_turns_by_an_angle():
    clean, noise = torch.ones(3, 1, 1), 2 * torch.ones(3, 1, 1)
    found = noised(clean, noise, torch.tensor([0.0, 1 / 3, 1.0])).flatten()
    torch.testing.assert_close(found, torch.tensor([1.0, math.sqrt(3) / 2 + 1.0, 2.0]))


def test_partial_denoising_follows_the_flow_of_a_gaussian():
    # With the best denoiser of N(0, s^2), the flow scales latents by s over their deviation at the level.
    model, latents = Gaussian(), torch.randn(2, 8, 5, generator=seeded(), dtype=torch.float64)
    level = torch.tensor([0.8, 0.3], dtype=torch.float64)
    angle = 0.5 * math.pi * level
    deviation = torch.sqrt((model.scale * torch.cos(angle)).square() + torch.sin(angle).square())
    exact = latents * (model.scale / deviation)[:, None, None]
    found = [partial_denoising(model, latents, level, None, steps=steps, guidance=1.0) for steps in (50, 100, 200)]
    errors = [float((each - exact).abs().max() / exact.abs().max()) for each in found]
    # A method of first order: twice the steps, half the error.
    assert errors[2] < 0.02
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.1)


def test_a_model_that_knows_what_it_wants_is_obeyed():
    wanted = sound_of(ringing_field(pitch=0.7))
    sounds = torch.cat([sound_of(ringing_field(level=each)) for each in (1.0, 1e-3)])
    targets = guide(Known(wanted), guidance=1.0).targets(sounds, 0, seeded())
    expected = levelled(wanted.expand(2, -1), sounds, sample_rate=RATE)
    torch.testing.assert_close(targets, expected, rtol=1e-4, atol=1e-6)


def test_another_rate_is_resampled_there_and_back():
    sounds = sound_of(ringing_field())
    model = Gaussian(sample_rate=44100.0)
    model.scale = 1e4  # Which takes everything for signal.
    targets = guide(model, lowest=0.001, highest=0.001).targets(sounds, 0, seeded())
    assert targets.shape == sounds.shape
    assert model.asked[0][1] == pytest.approx(0.5, abs=1e-4)
    # A noise of a thousandth of a quarter turn beside a sound whose peak is .5, and the filters' edge.
    assert float((targets - sounds).square().mean().sqrt() / sounds.square().mean().sqrt()) < 0.05


@pytest.mark.parametrize(
    ("name", "value"), [("lowest", 0.0), ("highest", 1.0), ("denoising", 0), ("batch", 0), ("guidance", math.inf)]
)
def test_settings_and_models_that_cannot_be_meant_are_refused(name, value):
    with raises(EditError, name=name, value=value):
        DistillationConfig(**{name: value})
    with raises(EditError, name="prompt", value=" \n"):
        DecoderDistillation(Known(), " \n", sample_rate=RATE)
    with raises(EditError, name="batch", value=1):
        guide(Gaussian(room=0), batch=1).targets(sound_of(ringing_field()), 0, seeded())
