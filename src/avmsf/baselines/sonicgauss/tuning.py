"""Training a generator by rectified flow, from scratch or on one object: AdamW, a warm-up, then a linear decay."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from avmsf.baselines.sonicgauss.conditioning import Normalized
from avmsf.baselines.sonicgauss.flow import STEPS
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError

Loss = Callable[[Int[Tensor, " batch"], torch.Generator], Float[Tensor, ""]]
"""Loss of the clips of these rows."""


@dataclass(frozen=True)
class TrainingConfig:
    """One training. The defaults of the optimizer are the published ones."""

    steps: int
    batch: int
    rate: float = 1e-4
    warmup: int = 200
    """Steps; at most half of all."""
    betas: tuple[float, float] = (0.9, 0.95)
    decay: float = 1e-2


@dataclass(frozen=True, eq=False, kw_only=True)
class TunedRenderer(ABC):
    """A generator fine-tuned to one object."""

    seen: Normalized
    """The object's Gaussians, in whose cube contacts are."""
    sample_rate: float
    """Hz."""
    samples: int
    report: Mapping[str, Any]
    seed: int = 0
    steps: int = STEPS

    @torch.no_grad()
    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return generated sounds, all from the same noise; directions are not known to the method."""
        rows = [self._sound(place) for place in self.seen.places(contacts)]
        return torch.stack(rows) if rows else torch.zeros(0, self.samples)

    @abstractmethod
    def _sound(self, place: Float[Tensor, "3"]) -> Float[Tensor, " samples"]:
        """Return the sound of a place in the cube."""


def expect_sound(loudest: float, impacts: Impacts) -> None:
    """Raise EvaluationError where the largest magnitude of the recordings is not above 0."""
    if not loudest > 0.0:
        raise EvaluationError(
            f"expected a recording with a sound, got {len(impacts)} silent ones ({', '.join(impacts.names[:3])}); "
            "record the impacts again",
            name="sounds",
            value=0.0,
        )


def train(
    parameters: Iterable[nn.Parameter],
    loss: Loss,
    clips: int,
    config: TrainingConfig,
    *,
    seed: int,
    log: Callable[[int, float], None] | None = None,
) -> list[float]:
    """Train in place on so many clips, in random order without repetition in each round, and return the losses.

    `log` is called with the step and its loss. All chance starts at `seed`, that of dropout too.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(parameters, lr=config.rate, betas=config.betas, weight_decay=config.decay)
    warmup = max(1, min(config.warmup, config.steps // 2))

    def factor(step: int) -> float:
        return min((step + 1) / warmup, (config.steps - step) / max(1, config.steps - warmup))

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    losses = []
    order = torch.empty(0, dtype=torch.int64)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for step in range(config.steps):
            while len(order) < config.batch:
                order = torch.cat([order, torch.randperm(clips, generator=generator)])
            rows, order = order[: config.batch], order[config.batch :]
            optimizer.zero_grad()
            value = loss(rows, generator)
            value.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
            losses.append(float(value.detach()))
            if log is not None:
                log(step + 1, losses[-1])
    return losses
