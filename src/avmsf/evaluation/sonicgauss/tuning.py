"""Training a generator by rectified flow, from scratch or on one object: AdamW, a warm-up, then a linear decay."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

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


def train(
    parameters: Iterable[nn.Parameter],
    loss: Loss,
    clips: int,
    config: TrainingConfig,
    *,
    seed: int,
    tell: Callable[[int, float], None] | None = None,
) -> list[float]:
    """Train in place on so many clips, in random order without repetition in each round, and return the losses.

    `tell` hears the step and its loss. All chance starts at `seed`, that of dropout too.
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
            if tell is not None:
                tell(step + 1, losses[-1])
    return losses
