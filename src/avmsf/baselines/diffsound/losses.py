"""The two objectives of DiffSound (Jin et al., SIGGRAPH 2024) between one predicted sound and recorded clips.

Both compare power spectrograms with a periodic Hann window and a hop of a quarter of the FFT, of sounds whose largest
sample is 1. The sizes and constants are those of the published program; the transport is geomloss's.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from geomloss import SamplesLoss
from jaxtyping import Float
from torch import Tensor

from avmsf.modal.spectra import magnitude_stft

TRANSPORT_FFT = 1024
"""The published program has 2048, too, which takes four times as long."""
DIFFERENCE_FFTS = (1024, 512, 256, 128, 64)
_FLOOR = 1e-7
"""Added to powers before logarithms."""
_LOG_SCALE = 40.0
"""Octaves of power over the floor that make a feature 1."""
_NEAR = 2
"""Bins on both sides of a mode whose points move with it."""
_BLUR = 0.01
"""Length of geomloss, the root of its temperature: .01 of the position axis is 160 Hz at 32 kHz."""


@dataclass(frozen=True, eq=False)
class ClipSpectra:
    """Recorded clips, and what is known of their spectra once for all predictions."""

    clips: Float[Tensor, "contacts samples"]
    """Of peak 1."""
    sample_rate: float
    """Hz."""

    def transport(
        self, predicted: Float[Tensor, " samples"], frequency: Float[Tensor, " modes"], *, row: int
    ) -> Float[Tensor, ""]:
        """Return the Sinkhorn divergence of a prediction's spectra from those of clip `row`.

        Each bin of a spectrogram is a point: its power at three moments, and its frequency over half the rate; once
        with logarithms of powers, once with powers. Gradients flow through the positions of the points near a mode
        alone, which are at the distance from its `frequency`, Hz, at which they are now. They move modes across gaps
        where spectra do not overlap.
        """
        own = _power(predicted[None], TRANSPORT_FFT)
        position = _positions(own.shape[1], frequency / (0.5 * self.sample_rate)).to(own)
        logs, powers = (_cloud(each, position)[0] for each in (_log_feature(own), own))
        return divergence(logs, self._clouds[0][row]) + divergence(powers, self._clouds[1][row])

    def difference(self, predicted: Float[Tensor, " samples"]) -> Float[Tensor, ""]:
        """Return the mean absolute difference of log2 powers plus that of powers, the mean over all clips.

        Frames weigh in proportion to their time; the row of 0 Hz is left out.
        """
        total = predicted.new_zeros(())
        for fft_size, (logs, powers) in self._spectra.items():
            own = _power(predicted[None], fft_size)[:, 1:]
            weight = torch.linspace(0.0, 0.1, own.shape[2], dtype=own.dtype, device=own.device)
            weight = weight / weight.mean()
            total = total + (weight * ((own + _FLOOR).log2() - logs).abs()).mean()
            total = total + (weight * (own - powers).abs()).mean()
        return total

    @cached_property
    def _clouds(self) -> tuple[Tensor, Tensor]:
        power = _power(self.clips, TRANSPORT_FFT)
        position = _positions(power.shape[1], None).to(power)
        return _cloud(_log_feature(power), position), _cloud(power, position)

    @cached_property
    def _spectra(self) -> dict[int, tuple[Tensor, Tensor]]:
        spectra = {}
        for fft_size in DIFFERENCE_FFTS:
            power = _power(self.clips, fft_size)[:, 1:]
            spectra[fft_size] = (power + _FLOOR).log2(), power
        return spectra


def _power(sounds: Float[Tensor, "contacts samples"], fft_size: int) -> Float[Tensor, "contacts bins frames"]:
    return magnitude_stft(sounds, fft_size=fft_size, hop=fft_size // 4).square()


def _log_feature(power: Float[Tensor, "contacts bins frames"]) -> Float[Tensor, "contacts bins frames"]:
    return ((power + _FLOOR).log2() - torch.tensor(_FLOOR).log2()) / _LOG_SCALE


def _positions(bins: int, modes: Float[Tensor, " modes"] | None) -> Float[Tensor, " bins"]:
    """Return each bin's place, 0 to 1; bins near a mode, at `modes` on the same axis, move with it."""
    place = torch.arange(bins, dtype=torch.float64) / bins
    if modes is None:
        return place
    moved = place.clone()
    for mode in modes:
        near = (place - mode.detach()).abs() <= (_NEAR + 0.5) / bins
        moved = torch.where(near, place + (mode - mode.detach()), moved)
    return moved


def _cloud(
    features: Float[Tensor, "contacts bins frames"], position: Float[Tensor, " bins"]
) -> Float[Tensor, "contacts bins 4"]:
    # Three moments of each row of a spectrogram.
    sampled = torch.nn.functional.interpolate(features.detach(), size=3, mode="linear")
    return torch.cat([sampled, position.expand(len(sampled), -1)[..., None]], dim=2)


def divergence(found: Float[Tensor, "points features"], wanted: Float[Tensor, "targets features"]) -> Float[Tensor, ""]:
    """Return the debiased Sinkhorn divergence of two clouds whose points weigh alike.

    Without blur it is half the mean squared distance of the best matching. Differentiable in both.
    """
    return SamplesLoss("sinkhorn", p=2, blur=_BLUR, backend="tensorized")(found, wanted)
