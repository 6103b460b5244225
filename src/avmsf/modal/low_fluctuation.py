"""White noise with little fluctuation of its short-time spectra.

The STFT magnitudes of two draws of Gaussian noise are independent, and both have Rayleigh distributions: their mean
absolute difference is 2 - sqrt(2) = .586 of their mean. The constant nearest to such magnitudes is their median, at
.419 of their mean. No sequence of samples has constant STFT magnitudes, but `generate` finds one whose magnitudes lie
closer to that median. The package contains its result; figures are in `docs/decisions/low-fluctuation-noise.md`.
"""

import math
from functools import cache
from importlib.resources import files

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

PERIOD = 131_072
"""Samples after which the sequence repeats: 3 s at 44.1 kHz."""
FFT_SIZES = (2048, 1024, 512, 256)
"""Hann windows in which the magnitudes are compared, samples, at hops of a quarter: those of the spectral loss."""
FILE = "low_fluctuation_noise.npy"
"""The sequence that the package contains, in float16."""


@cache
def white_sequence() -> Float[Tensor, " samples"]:
    """Return one period of the sequence, `PERIOD` samples. Do not write into it: all callers share it.

    It is white. Its level is such that its STFT magnitudes are near the median of those of Gaussian white noise of
    variance one; its root mean square is .78, because the median of a Rayleigh distribution is below its root mean
    square (sqrt(ln 2) = .83) and because the magnitudes are on average a little below it.
    """
    with files(__package__).joinpath(FILE).open("rb") as file:
        return torch.from_numpy(np.load(file).astype(np.float32))


def generate(*, steps: int = 120, period: int = PERIOD, rate: float = 0.03, seed: int = 0) -> Float[Tensor, " samples"]:
    """Return periodic noise of little fluctuation by Adam on the samples, from a draw of Gaussian noise.

    The loss is `fluctuation`; `rate` falls on a cosine to zero. `period` is a multiple of the largest FFT size. The
    file was written by `numpy.save(FILE, generate().numpy().astype("float16"))`, which takes some seconds. Other
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


def fluctuation(sequence: Float[Tensor, " samples"]) -> Float[Tensor, ""]:
    """Return the mean of |m / median - 1| over the STFT magnitudes m of a periodic sequence and over `FFT_SIZES`.

    The median is that of Gaussian white noise of variance one, for which the result is .446. 0 Hz and half the sample
    rate, where the distribution is another, are left out.
    """
    total = sequence.new_zeros(())
    for size in FFT_SIZES:
        window = torch.hann_window(size, dtype=sequence.dtype, device=sequence.device)
        median = (window.square().sum() * math.log(2)).sqrt()
        frames = torch.cat([sequence, sequence[: size - size // 4]]).unfold(0, size, size // 4)
        magnitudes = torch.fft.rfft(frames * window)[:, 1:-1].abs()
        total = total + (magnitudes / median - 1).abs().mean()
    return total / len(FFT_SIZES)
