"""How much the short-time spectra of a noise fluctuate."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FFT_SIZES = (2048, 1024, 512, 256)
"""Hann windows in which the magnitudes are compared, samples, at hops of a quarter: those of the spectral loss."""


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
