"""The small SonicGauss, fine-tuned to one object."""

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.baselines.sonicgauss.patches import CHANNELS, PATCHES, PatchCodec, log_magnitudes, sounds_of, spectra
from avmsf.baselines.sonicgauss.pretraining import clip_loss
from avmsf.baselines.sonicgauss.small import SmallSonicGauss, SmallWeights, object_tokens, visible
from avmsf.baselines.sonicgauss.training import TrainingConfig, TunedRenderer, expect_sound, integrate, train
from avmsf.capture.impacts import Impacts
from avmsf.gaussians.cloud import GaussianCloud

TUNING = TrainingConfig(steps=150, batch=8, rate=5e-4, warmup=20)
"""Fine-tuning to one object, whatever its number of recordings: half a minute on one core. The published program takes
80 rounds over the recordings in steps of two, at a rate of 1e-4, of weights that were trained for days."""


@dataclass(frozen=True, eq=False)
class SmallRenderer(TunedRenderer):
    """A fine-tuned network, and what places and levels mean for its object."""

    network: SmallSonicGauss
    codec: PatchCodec
    features: Float[Tensor, "tokens 23"]
    largest: float
    """Largest magnitude in the training recordings' spectra, in their unit times samples."""
    phases: Float[Tensor, "bins frames"]
    """Of the mean training recording, radians."""

    def _sound(self, place: Float[Tensor, "3"]) -> Float[Tensor, " samples"]:
        noise = torch.randn(1, PATCHES, CHANNELS, generator=torch.Generator().manual_seed(self.seed))
        tokens = self.network.condition(self.features[None], place[None])
        latents = integrate(lambda state, times: self.network(state, times, tokens), noise, steps=self.steps)
        # Training has seen no magnitude above the largest.
        logs = self.codec.decode(latents).clamp(max=0.0)
        magnitudes = self.largest * 10.0**logs
        return sounds_of(magnitudes, self.phases, sample_rate=self.sample_rate, samples=self.samples)[0]


def fit_small(
    weights: SmallWeights,
    cloud: GaussianCloud,
    train_impacts: Impacts,
    config: TrainingConfig = TUNING,
    *,
    seed: int = 0,
) -> SmallRenderer:
    """Fine-tune all of the network to an object's recordings, by the objective that it was trained with.

    Raises EvaluationError where the recordings are silent, and where nothing can be seen of the object.
    """
    network = copy.deepcopy(weights.network)
    seen = visible(cloud)
    features = object_tokens(seen, count=network.config.tokens)
    found = spectra(train_impacts.sounds, train_impacts.sample_rate)
    largest = float(found.abs().max())
    expect_sound(largest, train_impacts)
    latents, contacts = weights.codec.encode(log_magnitudes(found, largest)), seen.places(train_impacts.contacts)

    def loss(rows: Int[Tensor, " batch"], generator: torch.Generator) -> Tensor:
        owner = features.expand(len(rows), -1, -1)
        return clip_loss(network, owner, contacts[rows], latents[rows], generator=generator)

    losses = train(network.train().parameters(), loss, len(train_impacts), config, seed=seed)
    part = max(1, len(losses) // 10)
    report = {
        "first_loss": round(sum(losses[:part]) / part, 4),
        "last_loss": round(sum(losses[-part:]) / part, 4),
        "steps": config.steps,
    }
    return SmallRenderer(
        network.eval(),
        weights.codec,
        features,
        largest,
        found.mean(0).angle(),
        seen=seen,
        sample_rate=train_impacts.sample_rate,
        samples=train_impacts.sounds.shape[1],
        report=report,
        seed=seed,
    )
