"""Spectra of sounds as differentiable torch functions, one convention for losses, metrics and pictures.

A spectrogram's window is the periodic Hann window of the FFT's own length. Its frames are centered on the samples 0,
hop, 2 hop, ... with silence before the first and after the last sample, so that a sound of any length, shorter than the
FFT too, has 1 + samples // hop frames and its onset is in the middle of the first. Nothing is scaled: a steady sine of
amplitude A on a bin reads A fft_size / 4, and white noise of standard deviation s reads s sqrt(3 pi fft_size / 32) on
average. Gradients are finite everywhere, at silence too.
"""

import math

import torch
from jaxtyping import Float
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

    The transform takes each sound as periodic, so that one which does not end in silence wraps round at its ends.
    """
    samples = sounds.shape[1]
    # The analytic signal keeps positive frequencies twice; 0 Hz and, of an even length, half the rate are their own
    # mirror images and stay once.
    weights = torch.zeros(samples, dtype=sounds.dtype, device=sounds.device)
    weights[: (samples + 1) // 2] = 2.0
    weights[0] = 1.0
    if samples % 2 == 0:
        weights[samples // 2] = 1.0
    return torch.fft.ifft(torch.fft.fft(sounds) * weights).abs()


def log_mel(
    sounds: Float[Tensor, "contacts samples"],
    filters: Float[Tensor, "mels bins"],
    *,
    fft_size: int,
    hop: int,
    floor: float,
) -> Float[Tensor, "contacts mels frames"]:
    """Return the natural logarithm of filtered magnitudes, which are taken as `floor` where they lie below it.

    `filters` as `htk_filters` makes them for the same `fft_size`.
    """
    return torch.log(torch.clamp(filters @ magnitude_stft(sounds, fft_size=fft_size, hop=hop), min=floor))


def htk_filters(
    count: int, *, fft_size: int, sample_rate: float, lowest: float, highest: float
) -> Float[Tensor, "mels bins"]:
    """Return triangles of height one, evenly spaced on the mel scale 2595 log10(1 + f / 700).

    They fill the band from `lowest` to `highest`. Frequencies in Hz; float64. Raises ArrayError for a band outside 0 Hz
    to half the rate, and where a triangle is so narrow that it falls between two bins.
    """
    ends = [2595.0 * math.log10(1.0 + frequency / 700.0) for frequency in (lowest, highest)]
    mels = torch.linspace(ends[0], ends[1], count + 2, dtype=torch.float64)
    edges = 700.0 * (10.0 ** (mels / 2595.0) - 1.0)
    # Edges come back from the mel scale with rounding, so that the top may exceed half the rate by its last digit.
    if not 0.0 <= edges[0] < edges[-1] <= 0.5 * sample_rate * (1.0 + 1e-9):
        wanted = f"mel filters from 0 Hz or above to {0.5 * sample_rate:g} Hz, half the sample rate, at most"
        raise ArrayError.expected(wanted, f"{edges[0]:g} to {edges[-1]:g} Hz", name="highest")
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
