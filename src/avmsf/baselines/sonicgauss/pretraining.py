"""Training of the small SonicGauss from scratch, on simulated objects."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from avmsf.baselines.sonicgauss.flow import DROPPED, flow_loss
from avmsf.baselines.sonicgauss.objects import TrainingObject
from avmsf.baselines.sonicgauss.patches import PatchCodec, log_magnitudes, spectra
from avmsf.baselines.sonicgauss.small import SmallConfig, SmallSonicGauss, SmallWeights, object_tokens, visible
from avmsf.baselines.sonicgauss.tuning import TrainingConfig, train
from avmsf.errors import EvaluationError

_TOLD = 25
"""Steps between words of progress."""
_CURVE = 20
"""Points of the loss curve that is kept."""


@dataclass(frozen=True)
class PretrainingConfig:
    """Sizes and schedule; the defaults take a quarter of an hour on one core."""

    network: SmallConfig = field(default_factory=SmallConfig)
    training: TrainingConfig = field(
        default_factory=lambda: TrainingConfig(steps=1000, batch=24, rate=1e-3, warmup=100)
    )


def pretrain(
    objects: Iterable[TrainingObject],
    config: PretrainingConfig | None = None,
    *,
    seed: int = 0,
    log: Callable[[str], None] | None = None,
) -> SmallWeights:
    """Train on objects' recordings. Raises EvaluationError where there is no object."""
    config = PretrainingConfig() if config is None else config
    begun = time.process_time()
    tokens, places, logs = [], [], []
    for each in objects:
        seen = visible(each.cloud)
        found = spectra(each.sounds, each.sample_rate)
        tokens.append(object_tokens(seen, count=config.network.tokens))
        places.append(seen.places(each.contacts))
        logs.append(log_magnitudes(found, float(found.abs().max())))
    if not tokens:
        raise EvaluationError(
            "expected objects to train on, got none; make them with `training_objects`", name="objects", value=0
        )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = SmallSonicGauss(config.network)
    features = torch.stack(tokens)
    network.mean.copy_(features.mean((0, 1)))
    network.deviation.copy_(features.std((0, 1)).clamp(min=1e-3))
    codec = PatchCodec.of(logs, seed=seed)
    owners = torch.cat([torch.full((len(each),), row) for row, each in enumerate(places)])
    clips = _Clips(features, owners, torch.cat(places), torch.cat([codec.encode(each) for each in logs]))
    logs.clear()

    def say(step: int, loss: float) -> None:
        if log is not None and step % _TOLD == 0:
            log(f"step {step} of {config.training.steps}: loss {loss:.4f}, {time.process_time() - begun:.0f} s")

    losses = train(network.parameters(), clips.loss(network.train()), len(owners), config.training, seed=seed, log=say)
    report = {
        "objects": len(tokens),
        "clips": len(owners),
        "steps": config.training.steps,
        "batch": config.training.batch,
        "seed": seed,
        "losses": [round(value, 4) for value in _means(losses, _CURVE)],
        "seconds": round(time.process_time() - begun, 1),
    }
    return SmallWeights(network.eval(), codec, report)


@dataclass(frozen=True, eq=False)
class _Clips:
    """What the loss is computed of, a row for each recording."""

    features: Float[Tensor, "objects tokens 23"]
    owners: Int[Tensor, " clips"]
    places: Float[Tensor, "clips 3"]
    latents: Float[Tensor, "clips patches channels"]

    def loss(self, network: SmallSonicGauss) -> Callable[[Int[Tensor, " batch"], torch.Generator], Tensor]:
        """Return the loss of a network by rows."""

        def of(rows: Int[Tensor, " batch"], generator: torch.Generator) -> Tensor:
            return clip_loss(
                network, self.features[self.owners[rows]], self.places[rows], self.latents[rows], generator=generator
            )

        return of


def clip_loss(
    network: SmallSonicGauss,
    features: Float[Tensor, "batch tokens 23"],
    places: Float[Tensor, "batch 3"],
    latents: Float[Tensor, "batch patches channels"],
    *,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Return the flow's loss, a tenth of the conditions zeroed."""
    kept = torch.rand(len(latents), 1, 1, generator=generator) >= DROPPED
    tokens = network.condition(features, places) * kept
    return flow_loss(lambda state, times: network(state, times, tokens), latents, generator=generator)


def _means(values: list[float], count: int) -> list[float]:
    """Return means over at most `count` equal spans."""
    span = max(1, len(values) // count)
    return [sum(values[start : start + span]) / span for start in range(0, span * (len(values) // span), span)]
