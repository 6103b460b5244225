"""The mean of the nearest sounds as spectra, in which phases do not cancel."""

from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from avmsf.capture.impacts import Impacts
from avmsf.errors import EvaluationError
from avmsf.gaussians.points import nearest_points
from avmsf.modal.config import scaled_fft_size


@dataclass(frozen=True, eq=False)
class MeanSpectra:
    """The mean magnitudes of the nearest training sounds' short-time spectra, with the phases of the nearest one's.

    The phases of one recording are consistent between frames and bins, so that the sound has nearly the mean
    magnitudes. Where a bin of the nearest is silent, its phase is zero.
    """

    train: Impacts
    count: int = 3
    """How many sounds are averaged."""
    fft_size: int = 1024
    """Samples of the Hann window at 44.1 and 48 kHz; other rates go as `scaled_fft_size`. The hop is a quarter."""

    def __post_init__(self) -> None:
        if not 1 <= self.count <= len(self.train):
            raise EvaluationError(
                f"expected a count of 1 to {len(self.train)} nearest training impacts, got {self.count}",
                name="count",
                value=self.count,
            )
        if self.fft_size < 16:
            raise EvaluationError(
                f"expected an FFT size of 16 samples or more, got {self.fft_size}", name="fft_size", value=self.fft_size
            )

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return self.train.sample_rate

    def render(
        self, contacts: Float[Tensor, "contacts 3"], *, directions: Float[Tensor, "contacts 3"] | None = None
    ) -> Float[Tensor, "contacts samples"]:
        """Return the sounds whose spectra the means are."""
        rows = nearest_points(self.train.contacts, contacts, count=self.count)
        # A contact at a time: the spectra of all together would be many times larger than their sounds.
        sounds = [self._mean(self.train.sounds[each]) for each in rows]
        return torch.stack(sounds) if sounds else self.train.sounds[:0]

    def _mean(self, sounds: Float[Tensor, "neighbors samples"]) -> Float[Tensor, " samples"]:
        spectra = self._transform(sounds)
        mixed = torch.polar(spectra.abs().mean(dim=0), spectra[0].angle())
        size = self._size
        return torch.istft(mixed, size, size // 4, window=self._window(sounds), center=True, length=sounds.shape[1])

    def _transform(self, sounds: Float[Tensor, "neighbors samples"]) -> Complex[Tensor, "neighbors bins frames"]:
        size = self._size
        return torch.stft(
            sounds,
            size,
            size // 4,
            window=self._window(sounds),
            center=True,
            pad_mode="constant",
            return_complex=True,
        )

    @property
    def _size(self) -> int:
        return 4 * max(1, round(scaled_fft_size(self.fft_size, sample_rate=self.sample_rate) / 4))

    def _window(self, sounds: Float[Tensor, "neighbors samples"]) -> Float[Tensor, " size"]:
        return torch.hann_window(self._size, dtype=sounds.dtype, device=sounds.device)
