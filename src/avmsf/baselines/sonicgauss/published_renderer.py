"""The published SonicGauss, fine-tuned to one object."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.baselines.sonicgauss.conditioning import first_nine, normalized
from avmsf.baselines.sonicgauss.flow import DROPPED, flow_loss, integrate
from avmsf.baselines.sonicgauss.published import FRAMES, LONGEST, PublishedSonicGauss
from avmsf.baselines.sonicgauss.tuning import TrainingConfig, TunedRenderer, expect_sound, train
from avmsf.capture.impacts import Impacts
from avmsf.editing.clips import lasting, resampled
from avmsf.gaussians.cloud import GaussianCloud

EPOCHS, BATCH = 80, 2
"""Rounds over an object's recordings, and recordings a step, as published."""


@dataclass(frozen=True, eq=False)
class PublishedRenderer(TunedRenderer):
    """A fine-tuned model, and what places and levels mean for its object; its sounds end after 2.97 s."""

    model: PublishedSonicGauss
    peak: float
    """Of the loudest training recording, in the recordings' unit."""

    @cached_property
    def _tokens(self) -> Float[Tensor, "1 tokens width"]:
        """The encoded Gaussians, the same for all contacts."""
        with torch.no_grad():
            return self.model.gaussians(self.seen)

    def _sound(self, place: Float[Tensor, "3"]) -> Float[Tensor, " samples"]:
        model, device = self.model, _device_of(self.model)
        channels = int(model.sizes.transformer["in_channels"])
        noise = torch.randn(1, FRAMES, channels, generator=torch.Generator().manual_seed(self.seed)).to(device)
        tokens = model.condition(self._tokens, place[None].to(device))
        seconds = self.samples / self.sample_rate
        latents = integrate(lambda z, s: model.velocity(z, s, tokens, seconds=seconds), noise, steps=self.steps)
        sound = model.autoencoder.decode(latents.mT).sample.mean(1).float().cpu()
        rate = float(model.autoencoder.config.sampling_rate)
        return self.peak * lasting(resampled(sound, sample_rate=rate, wanted=self.sample_rate), self.samples)[0]


def fit_published(
    model: PublishedSonicGauss, cloud: GaussianCloud, train_impacts: Impacts, *, epochs: int = EPOCHS, seed: int = 0
) -> PublishedRenderer:
    """Fine-tune a model in place to an object's recordings, as published, on the device where it is.

    Recordings are divided by the loudest one's peak. Batch norms keep their statistics, and the last weights are taken:
    there are too few recordings to leave some out. Raises EvaluationError where the recordings are silent, and where
    nothing can be seen of the object.
    """
    device = _device_of(model)
    seen = normalized(cloud, first_nine(cloud))
    peak = float(train_impacts.sounds.abs().max())
    expect_sound(peak, train_impacts)
    contacts = seen.places(train_impacts.contacts).float().to(device)
    seconds = min(train_impacts.duration, LONGEST)
    means, deviations = _encoded(model, train_impacts, peak)

    def loss(rows: Int[Tensor, " batch"], generator: torch.Generator) -> Tensor:
        noise = torch.randn(means[rows].shape, generator=generator)
        latents = (means[rows] + deviations[rows] * noise).to(device)
        kept = (torch.rand(len(rows), 1, 1, generator=generator) >= DROPPED).to(latents)
        tokens = model.condition(model.gaussians(seen), contacts[rows.to(device)])
        return flow_loss(
            lambda z, s: model.velocity(z, s, tokens, seconds=seconds, kept=kept), latents, generator=generator
        )

    config = TrainingConfig(steps=epochs * math.ceil(len(train_impacts) / BATCH), batch=BATCH)
    model.train().autoencoder.eval()
    for part in model.gaussians.modules():
        if isinstance(part, torch.nn.BatchNorm1d):
            part.eval()
    losses = train(model.trained(), loss, len(train_impacts), config, seed=seed)
    report = {"steps": len(losses), "first_loss": round(losses[0], 4), "last_loss": round(losses[-1], 4)}
    rate, samples = train_impacts.sample_rate, train_impacts.sounds.shape[1]
    return PublishedRenderer(model.eval(), peak, seen=seen, sample_rate=rate, samples=samples, report=report, seed=seed)


@torch.no_grad()
def _encoded(
    model: PublishedSonicGauss, impacts: Impacts, peak: float
) -> tuple[Float[Tensor, "contacts frames channels"], Float[Tensor, "contacts frames channels"]]:
    """Return means and deviations of the recordings' latents; published training draws from them anew each time."""
    autoencoder = model.autoencoder
    rate, samples = float(autoencoder.config.sampling_rate), FRAMES * int(autoencoder.hop_length)
    sounds = lasting(resampled(impacts.sounds.float() / peak, sample_rate=impacts.sample_rate, wanted=rate), samples)
    channels = int(autoencoder.config.audio_channels)
    found = [
        autoencoder.encode(each[None, None].expand(-1, channels, -1).to(_device_of(model))).latent_dist
        for each in sounds
    ]
    return torch.cat([each.mean for each in found]).mT.cpu(), torch.cat([each.std for each in found]).mT.cpu()


def _device_of(model: PublishedSonicGauss) -> torch.device:
    return next(model.fusion.parameters()).device
