"""Named sets of metrics with all their parameters: values of one convention may be compared, others not.

The paper describes its metrics in words. `PAPER` is the reading that its own values support. Sixty clips of Gaussian
white noise, 3 s at 48 kHz with peak one, against silence score L1 3.74 and ENV .305 in it, a ratio of 12.27 at any
level; the paper's rows for white noise have 3.774 and .305 (12.37), and 3.789 and .308 (12.30), where FFT sizes of 512
and 2048 would give 8.67 and 17.33. For L1-log the paper's 6.859 lies between what such noise scores against eight
ObjectFolder Real clips as recorded, 8.8, and scaled to peak one, 6.1, with triangles of height one on magnitudes; on
squared magnitudes it would be 12 to 15. It remains an inference: compare ratios with the paper's, not absolute values.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from avmsf.evaluation.metrics import (
    PerContact,
    envelope_distance,
    log_mel_distance,
    objectfolder_distance,
    spectrogram_distance,
)
from avmsf.modal.config import scaled_fft_size


class Convention(ABC):
    """A set of metrics under one name."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What a report calls the convention."""

    @abstractmethod
    def scores(
        self, predicted: Float[Tensor, "..."], truth: Float[Tensor, "..."], *, sample_rate: float
    ) -> dict[str, PerContact]:
        """Return each metric's figure for every contact, by the metric's name."""


@dataclass(frozen=True)
class PaperConvention(Convention):
    """The paper's L1, L1-log and ENV at the capture's own sample rate: keys `l1`, `l1_log` and `envelope`.

    FFT size, hop and number of mel bands are for 44.1 and 48 kHz; at other rates all three go as `scaled_fft_size`.
    """

    fft_size: int = 1024
    """Samples of the Hann window."""
    hop: int = 256
    """Samples from frame to frame."""
    mel_count: int = 80
    """Mel bands from 0 Hz to half the rate; never more than this."""
    floor: float = 1e-5
    """Smallest mel magnitude, in the sounds' unit."""

    @property
    def name(self) -> str:
        """What a report calls the convention."""
        return "paper"

    def scores(
        self, predicted: Float[Tensor, "..."], truth: Float[Tensor, "..."], *, sample_rate: float
    ) -> dict[str, PerContact]:
        """Return `l1`, `l1_log` and `envelope` of every contact; raises EvaluationError as the metrics do."""
        fft_size = scaled_fft_size(self.fft_size, sample_rate=sample_rate)
        hop = scaled_fft_size(self.hop, sample_rate=sample_rate)
        mel_count = min(self.mel_count, scaled_fft_size(self.mel_count, sample_rate=sample_rate))
        return {
            "l1": spectrogram_distance(predicted, truth, fft_size=fft_size, hop=hop),
            "l1_log": log_mel_distance(
                predicted,
                truth,
                sample_rate=sample_rate,
                fft_size=fft_size,
                hop=hop,
                mel_count=mel_count,
                floor=self.floor,
            ),
            "envelope": envelope_distance(predicted, truth),
        }


@dataclass(frozen=True)
class ObjectFolderConvention(Convention):
    """The ObjectFolder benchmark's spectrogram and envelope distance: keys `spectrogram` and `envelope`.

    The spectrogram at 22,050 Hz, the envelope at the capture's own rate; nothing to choose.
    """

    @property
    def name(self) -> str:
        """What a report calls the convention."""
        return "objectfolder"

    def scores(
        self, predicted: Float[Tensor, "..."], truth: Float[Tensor, "..."], *, sample_rate: float
    ) -> dict[str, PerContact]:
        """Return `spectrogram` and `envelope` of every contact; raises EvaluationError below 15.2 kHz."""
        return {
            "spectrogram": objectfolder_distance(predicted, truth, sample_rate=sample_rate),
            "envelope": envelope_distance(predicted, truth),
        }


PAPER = PaperConvention()
OBJECTFOLDER = ObjectFolderConvention()
