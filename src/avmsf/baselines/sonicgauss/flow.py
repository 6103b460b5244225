"""Rectified flow (Liu et al. 2023; Esser et al. 2024): straight lines from noise to data, and their velocity.

At time s from 0 to 1 there is z_s = (1 - s) z + s e of data z and Gaussian noise e, whose velocity is e - z.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

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
