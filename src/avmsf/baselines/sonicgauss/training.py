"""Rectified flow (Liu et al. 2023; Esser et al. 2024), and training a generator by it, from scratch or on one object.

At time s from 0 to 1 there is z_s = (1 - s) z + s e of data z and Gaussian noise e, whose velocity is e - z. Training
is by AdamW with a warm-up, then a linear decay.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from avmsf.baselines.sonicgauss.conditioning import Normalized
from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError

STEPS = 50
"""Euler steps from noise to data, as published."""
DROPPED = 0.1
"""Part of the training conditions that are zeroed, as published."""

Velocity = Callable[[Float[Tensor, "batch tokens channels"], Float[Tensor, " batch"]], Tensor]
"""Velocity [batch tokens channels] at latents and times."""


def draw_times(count: int, *, generator: torch.Generator) -> Float[Tensor, " batch"]:
    """Return times between 0 and 1 whose logits are standard normal."""
    return torch.sigmoid(torch.randn(count, generator=generator))


def flow_loss(
    velocity: Velocity, data: Float[Tensor, "batch tokens channels"], *, generator: torch.Generator
) -> Float[Tensor, ""]:
    """Return the mean squared error of the velocity at one random time for each row of the data."""
    noise = torch.randn(data.shape, generator=generator).to(data)
    times = draw_times(len(data), generator=generator).to(data)
    weight = times[:, None, None]
    return torch.nn.functional.mse_loss(velocity((1 - weight) * data + weight * noise, times), noise - data)


@torch.no_grad()
def integrate(
    velocity: Velocity, noise: Float[Tensor, "batch tokens channels"], *, steps: int = STEPS
) -> Float[Tensor, "batch tokens channels"]:
    """Return the data that noise flows to, by Euler steps at the times 1, 1 - 1/steps, ..., 1/steps."""
    latents = noise
    for step in range(steps, 0, -1):
        times = latents.new_full((len(latents),), step / steps)
        latents = latents - velocity(latents, times) / steps
    return latents


def load_tensors(part: nn.Module, tensors: Mapping[str, Tensor], path: Path, advice: str) -> None:
    """Fill a network. Raises EvaluationError that names the tensors that are missing, unknown or of another shape."""
    try:
        part.load_state_dict(tensors)
    except RuntimeError as error:
        reason = " ".join(" ".join(str(error).splitlines()[1:]).split())[:400]
        wanted, got = "the tensors of this model", f"others: {reason}"
        raise EvaluationError.expected(wanted, got=got, file=path, name="tensors", advice=advice) from error


Loss = Callable[[Int[Tensor, " batch"], torch.Generator], Float[Tensor, ""]]
"""Loss of the clips of these rows."""


@dataclass(frozen=True)
class TrainingConfig:
    """One training. The defaults, and the optimizer's other settings, are the published ones."""

    steps: int
    batch: int
    rate: float = 1e-4
    warmup: int = 200
    """Steps; at most half of all."""


@dataclass(frozen=True, eq=False)
class TunedRenderer:
    """A generator fine-tuned to one object."""

    seen: Normalized
    """The object's Gaussians, in whose cube contacts are."""
    sample_rate: float
    """Hz."""
    samples: int
    generate: Callable[[Float[Tensor, "1 3"], int], Float[Tensor, " samples"]]
    """Makes the sound of a place in the cube by so many Euler steps, always from the same noise."""
    steps: int = STEPS

    @torch.no_grad()
    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return generated sounds; directions are not known to the method."""
        rows = [self.generate(place[None], self.steps) for place in self.seen.places(contacts)]
        return torch.stack(rows) if rows else torch.zeros(0, self.samples)


def expect_sound(loudest: float, impacts: Impacts) -> None:
    """Raise EvaluationError where the largest magnitude of the recordings is not above 0."""
    if not loudest > 0.0:
        got, advice = f"{len(impacts)} silent ones ({', '.join(impacts.names[:3])})", "record the impacts again"
        raise EvaluationError.expected("a recording with a sound", 0.0, got=got, name="sounds", advice=advice)


def train(
    parameters: Iterable[nn.Parameter], loss: Loss, clips: int, config: TrainingConfig, *, seed: int
) -> list[float]:
    """Train in place on so many clips, in random order without repetition in each round, and return the losses.

    All chance starts at `seed`, that of dropout too.
    """
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(parameters, lr=config.rate, betas=(0.9, 0.95), weight_decay=1e-2)
    warmup = max(1, min(config.warmup, config.steps // 2))

    def factor(step: int) -> float:
        return min((step + 1) / warmup, (config.steps - step) / max(1, config.steps - warmup))

    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, factor)
    losses = []
    order = torch.empty(0, dtype=torch.int64)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(config.steps):
            while len(order) < config.batch:
                order = torch.cat([order, torch.randperm(clips, generator=generator)])
            rows, order = order[: config.batch], order[config.batch :]
            optimizer.zero_grad()
            value = loss(rows, generator)
            value.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
            losses.append(float(value.detach()))
    return losses
