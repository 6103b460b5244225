"""`python -m benchmarks.low_fluctuation FILE.npy`: make the package's noise of low fluctuation, in some seconds."""

import sys

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.modal.residual_noise import PERIOD
from tests.oracles.fluctuation import fluctuation


def generate(*, steps: int = 120, period: int = PERIOD, rate: float = 0.03, seed: int = 0) -> Float[Tensor, " samples"]:
    """Return periodic noise of little fluctuation by Adam on the samples, from a draw of Gaussian noise.

    The loss is `fluctuation`; `rate` falls on a cosine to zero. `period` is a multiple of the largest FFT size. Other
    machines round differently and find another sequence of the same fluctuation.
    """
    sequence = torch.randn(period, generator=torch.Generator().manual_seed(seed)).requires_grad_()
    optimizer = torch.optim.Adam([sequence], lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        fluctuation(sequence).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return sequence.detach()


if __name__ == "__main__":
    np.save(sys.argv[1], generate().numpy().astype("float16"))
