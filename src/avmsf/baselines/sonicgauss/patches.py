"""Latents of the small SonicGauss: log spectrograms in patches of frequency, by principal components.

A patch is 16 bins (250 Hz) over all of 2 s at 32 kHz; 64 patches reach 16 kHz. Decays are smooth and lines sharp, so
that few components of a patch keep both. Phases are not kept: they are found by Griffin and Lim's algorithm.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from torch import Tensor, nn

from avmsf.editing.clips import resampled, with_length

RATE = 32_000.0
"""Hz."""
SAMPLES = 64_000
FFT, HOP = 2048, 512
PATCHES, BINS = 64, 16
FRAMES = 1 + SAMPLES // HOP
VALUES = BINS * FRAMES
CHANNELS = 32
"""Principal components of a patch; further ones hold the noise of single recordings."""
FLOOR = -4.0
"""Decadic logarithm of the least magnitude, over the object's largest."""
_ITERATIONS, _MOMENTUM = 32, 0.99 / 1.99
"""Of the fast Griffin-Lim algorithm (Perraudin et al. 2013), as torchaudio has them by default."""


class PatchCodec(nn.Module):
    """A linear map of log spectrograms to latents and back: orthonormal components, and what they are divided by."""

    mean: Tensor
    components: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(VALUES))
        self.register_buffer("components", torch.zeros(VALUES, CHANNELS))
        self.register_buffer("scale", torch.ones(CHANNELS))

    @classmethod
    def of(cls, logs: Sequence[Float[Tensor, "contacts bins frames"]], *, seed: int) -> "PatchCodec":
        """Return the principal components of log spectrograms' patches.

        Coefficients are divided by the root of their deviation: faint ones, mostly noise, stay fainter than the rest.
        """
        rows, codec = torch.cat([_patches(each).flatten(0, 1) for each in logs]), cls()
        codec.mean = rows.mean(0)
        rows = rows - codec.mean
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            components = torch.pca_lowrank(rows, q=2 * CHANNELS, center=False, niter=3)[2][:, :CHANNELS]
        codec.components = components.contiguous()
        deviation = (rows @ components).std(0)
        codec.scale = (deviation * deviation.max()).sqrt()
        return codec

    def encode(self, logs: Float[Tensor, "contacts bins frames"]) -> Float[Tensor, "contacts patches channels"]:
        """Return the latents of log spectrograms."""
        return ((_patches(logs) - self.mean) @ self.components) / self.scale

    def decode(self, latents: Float[Tensor, "contacts patches channels"]) -> Float[Tensor, "contacts bins frames"]:
        """Return the log spectrograms of latents."""
        rows = (latents * self.scale) @ self.components.T + self.mean
        return rows.reshape(len(rows), PATCHES * BINS, FRAMES)


def spectra(sounds: Float[Tensor, "contacts samples"], sample_rate: float) -> Complex[Tensor, "contacts bins frames"]:
    """Return spectra of the first 2 s at 32 kHz; shorter sounds are continued by silence. Hann windows, centered."""
    clips = with_length(resampled(sounds.float(), sample_rate=sample_rate, wanted=RATE), SAMPLES)
    found = torch.stft(
        clips, FFT, HOP, window=torch.hann_window(FFT), center=True, pad_mode="constant", return_complex=True
    )
    return found[:, : PATCHES * BINS]


def log_magnitudes(
    spectrum: Complex[Tensor, "contacts bins frames"], largest: float
) -> Float[Tensor, "contacts bins frames"]:
    """Return decadic logarithms of magnitudes over the largest, `FLOOR` and above."""
    return (spectrum.abs() / largest).clamp(min=10.0**FLOOR).log10()


def sounds_of(
    magnitudes: Float[Tensor, "contacts bins frames"],
    phases: Float[Tensor, "bins frames"],
    *,
    sample_rate: float,
    samples: int,
) -> Float[Tensor, "contacts samples"]:
    """Return sounds of these magnitudes, whose phases are sought from the given ones on (fast Griffin-Lim)."""
    window = torch.hann_window(FFT)
    # The bin at half the rate is not kept.
    magnitudes, phases = (torch.nn.functional.pad(each, (0, 0, 0, 1)) for each in (magnitudes, phases))
    found = torch.polar(magnitudes, phases.expand_as(magnitudes).contiguous())
    before = torch.zeros_like(found)
    for _ in range(_ITERATIONS):
        sounds = torch.istft(found, FFT, HOP, window=window, length=SAMPLES)
        now = torch.stft(sounds, FFT, HOP, window=window, center=True, pad_mode="constant", return_complex=True)
        found = torch.polar(magnitudes, (now - _MOMENTUM * before).angle())
        before = now
    sounds = torch.istft(found, FFT, HOP, window=window, length=SAMPLES)
    return with_length(resampled(sounds, sample_rate=RATE, wanted=sample_rate), samples)


def _patches(logs: Float[Tensor, "contacts bins frames"]) -> Float[Tensor, "contacts patches values"]:
    return logs.reshape(len(logs), PATCHES, VALUES)
