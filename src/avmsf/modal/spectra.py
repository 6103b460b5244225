"""Spectra, envelopes and levels of sounds, one convention for losses, metrics and pictures.

A spectrogram's window is the periodic Hann window of the FFT's own length. Its frames are centered on the samples 0,
hop, 2 hop, ... with silence before the first and after the last sample, so that a sound of any length, shorter than the
FFT too, has 1 + samples // hop frames and its onset is in the middle of the first. Nothing is scaled: a steady sine of
amplitude A on a bin reads A fft_size / 4, and white noise of standard deviation s reads s sqrt(3 pi fft_size / 32) on
average. Its gradient is finite everywhere, at silence too.
"""

import math
from fractions import Fraction

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import hilbert, resample_poly
from torch import Tensor

from avmsf.errors import ArrayError


def magnitude_stft(
    sounds: Float[Tensor, "contacts samples"], *, fft_size: int, hop: int
) -> Float[Tensor, "contacts bins frames"]:
    """Return the magnitudes of the short-time Fourier transform, fft_size // 2 + 1 bins from 0 Hz to half the rate.

    `fft_size` and `hop` in samples; the unit is that of the sounds times samples (see the module's text).
    """
    window = torch.hann_window(fft_size, dtype=sounds.dtype, device=sounds.device)
    spectra = torch.stft(sounds, fft_size, hop, window=window, center=True, pad_mode="constant", return_complex=True)
    # The slope of |z| is z / |z|, which torch takes as zero at z = 0; sqrt(re^2 + im^2) would give NaN there.
    return spectra.abs()


def envelope(sounds: Float[Tensor, "contacts samples"]) -> Float[Tensor, "contacts samples"]:
    """Return the amplitude envelopes, in the sounds' unit: the magnitude of the analytic signal (Hilbert).

    The transform takes each sound as periodic, so that one which does not end in silence wraps round at its ends. It is
    not differentiable.
    """
    return torch.from_numpy(np.abs(hilbert(sounds.detach().cpu().numpy(), axis=1))).to(sounds)


def htk_filters(count: int, *, fft_size: int, sample_rate: float) -> Float[Tensor, "mels bins"]:
    """Return triangles of height one, evenly spaced on the mel scale 2595 log10(1 + f / 700) up to half the rate, Hz.

    In float64. Raises ArrayError where a triangle is so narrow that it falls between two bins.
    """
    top = 2595.0 * math.log10(1.0 + 0.5 * sample_rate / 700.0)
    edges = 700.0 * (10.0 ** (torch.linspace(0.0, top, count + 2, dtype=torch.float64) / 2595.0) - 1.0)
    bins = torch.arange(fft_size // 2 + 1, dtype=torch.float64) * (sample_rate / fft_size)
    rising = (bins - edges[:-2, None]) / (edges[1:-1] - edges[:-2])[:, None]
    falling = (edges[2:, None] - bins) / (edges[2:] - edges[1:-1])[:, None]
    triangles = torch.clamp(torch.minimum(rising, falling), min=0.0)
    empty = torch.nonzero(triangles.sum(dim=1) == 0.0).flatten()
    if len(empty):
        wanted = f"mel filters that each hold a bin of an FFT of {fft_size} samples at {sample_rate:g} Hz"
        got = f"{count} filters, of which number {int(empty[0]) + 1} falls between two bins"
        raise ArrayError.expected(wanted, count, got=got, name="count", advice="use fewer filters or a longer FFT")
    return triangles


Sounds = Float[Tensor, "contacts samples"]
"""One a row."""


def resampled(sounds: Sounds, *, sample_rate: float, wanted: float) -> Float[Tensor, "contacts resampled"]:
    """Return sounds at another sample rate, Hz, by a polyphase filter; they are not differentiable in what was given.

    What lies above half the lower of the two rates is lost. Dtype and device stay. The ratio of the rates is the
    nearest with a denominator up to 20,000, exact for all rates in use.
    """
    if sample_rate == wanted:
        return sounds
    ratio = (Fraction(wanted) / Fraction(sample_rate)).limit_denominator(20_000)
    found = resample_poly(sounds.detach().cpu().double().numpy(), ratio.numerator, ratio.denominator, axis=1)
    return torch.from_numpy(found).to(sounds)


def with_length(sounds: Sounds, samples: int) -> Float[Tensor, "contacts lasting"]:
    """Return sounds of `samples` samples: cut at the end, or continued by silence."""
    missing = samples - sounds.shape[1]
    return torch.nn.functional.pad(sounds, (0, missing)) if missing > 0 else sounds[:, :samples]


def level(sounds: Sounds, *, sample_rate: float) -> Float[Tensor, " contacts"]:
    """Return each sound's root mean square over its loudest 20 ms, which does not depend on its decay time.

    That is about how long loudness integrates a click. Differentiable; never zero, so that it can be a divisor.
    """
    window = min(sounds.shape[1], max(1, round(0.02 * sample_rate)))
    power = torch.nn.functional.avg_pool1d(sounds.square()[:, None], window, max(1, window // 4))[:, 0]
    return power.amax(dim=1).clamp_min(torch.finfo(sounds.dtype).tiny).sqrt()


def levelled(sounds: Sounds, like: Sounds, *, sample_rate: float) -> Sounds:
    """Return sounds scaled, row for row, to the level of `like`."""
    return sounds * (level(like, sample_rate=sample_rate) / level(sounds, sample_rate=sample_rate))[:, None]
