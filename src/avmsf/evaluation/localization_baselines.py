"""Baselines of localization: a random point, and the contact of the recording with the most similar spectrum."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.modal.config import scaled_fft_size

_FFT_SIZE = 4096
"""Samples of a Hann window at 44.1 and 48 kHz: its bins part modes some twenty hertz apart."""
_FLOOR = 1e-6
"""Power over the loudest bin's below which differences do not count: -60 dB."""


@dataclass(frozen=True, eq=False)
class NearestSpectrum:
    """The contact of the training recording with the most similar spectrum, independent of level."""

    train: Impacts

    def row(self, sound: Float[Tensor, " samples"]) -> int:
        """Return the training recording's row.

        Training recordings that are silent are never the nearest. Raises EvaluationError for a sound that is silent.
        """
        if not bool(sound.any()):
            raise EvaluationError("expected a recording, got silence; omit it", name="sound", value=0.0)
        alike = self._signatures @ self._signature(sound)
        return int(torch.where(self.train.sounds.any(dim=1), alike, -torch.inf).argmax())

    def place(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " 3"]:
        """Return the contact of that recording, meters."""
        return self.train.contacts[self.row(sound)].double()

    @cached_property
    def _signatures(self) -> Float64[Tensor, "contacts bins"]:
        return torch.stack([self._signature(sound) for sound in self.train.sounds])

    def _signature(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " bins"]:
        """Return the log of the mean power spectrum, of mean zero and norm one: products are correlations.

        Zero for silence.
        """
        size = scaled_fft_size(_FFT_SIZE, sample_rate=self.train.sample_rate)
        padded = torch.nn.functional.pad(sound.double(), (0, max(0, size - len(sound))))
        window = torch.hann_window(size, dtype=torch.float64)
        # Frames from before the onset on, so that its window weighs the beginning of the sound too.
        frames = torch.nn.functional.pad(padded, (size // 2, size // 2)).unfold(0, size, size // 4)
        power = torch.fft.rfft(frames * window).abs().square().mean(dim=0)
        if not float(power.max()) > 0.0:
            return torch.zeros_like(power)
        level = torch.log(power.clamp_min(_FLOOR * float(power.max())))
        centered = level - level.mean()
        return centered / centered.norm().clamp_min(torch.finfo(torch.float64).tiny)


def random_distance(points: Float[Tensor, "points 3"], right: Float[Tensor, "images 3"]) -> float:
    """Return how far a point drawn evenly from an object's points is expected to be from the nearest right place."""
    nearest = [torch.cdist(part.double(), right.double()).amin(dim=1) for part in torch.split(points, 1024)]
    return float(torch.cat(nearest).mean())
