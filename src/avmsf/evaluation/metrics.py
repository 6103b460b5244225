"""How far rendered sounds are from recorded ones.

Conventions. `predicted` and `truth` are sounds [contacts, samples] of one sample rate and one unit, row for row the
same contact; nothing is aligned, scaled or trimmed. Every metric is zero for equal sounds, lower is better, and it
returns one value a contact, in float64: their mean is the score, and their standard deviation gives its standard
error. Every metric calls `validate` first, which raises EvaluationError with the row at fault.

- `relative_stft_error`: differences of STFT magnitudes in proportion to the truth's. Free of unit and level: 0 is
  perfect, 1 is silence. The measure that objects and methods are compared by here.
- `spectrogram_distance` (L1), `log_mel_distance` (L1-log) and `envelope_distance` (ENV): the paper's three. Sizes in
  samples are the paper's at 44.1 and 48 kHz, and go as `scaled_fft_size` at other rates.

CDPAM is in `avmsf.evaluation.cdpam`; modes are compared with true ones in `avmsf.evaluation.modal_metrics`.
"""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.errors import EvaluationError
from avmsf.modal.config import scaled_fft_size
from avmsf.modal.spectra import envelope, htk_filters, magnitude_stft

# `validate` reports shapes that differ, so the annotations leave them open.
Sounds = Float[Tensor, "..."]
PerContact = Float64[Tensor, " contacts"]

_BLOCK = 16
"""Sounds compared at a time: bounds the memory that their spectrograms take."""


def validate(predicted: Sounds, truth: Sounds, *, names: Sequence[str] | None = None) -> None:
    """Raise EvaluationError unless both are [contacts, samples] of one shape, not empty, and finite throughout.

    The message names a row by `names`, or else by its index.
    """
    _expect_rows(predicted, "predicted")
    _expect_rows(truth, "truth")
    if len(predicted) != len(truth):
        raise EvaluationError.expected(f"one for each of {len(truth)} true sounds", len(predicted), name="predicted")
    if predicted.shape[1] != truth.shape[1]:
        wanted, advice = f"sounds of {truth.shape[1]} samples as the true ones", "check sample rates and durations"
        raise EvaluationError.expected(wanted, list(predicted.shape), name="predicted", advice=advice)
    _expect_numbers(predicted, "predicted", names)
    _expect_numbers(truth, "truth", names)


def validate_sounds(sounds: Sounds, *, sample_rate: float, wanted: float) -> None:
    """Raise EvaluationError unless `sounds` are [contacts, samples], not empty, finite, and can be resampled to a rate.

    Rates in Hz; that of the sounds is a positive number, and a thousandth of the wanted one or more.
    """
    _expect_rows(sounds, "sounds")
    _expect_numbers(sounds, "sounds", None)
    if not (math.isfinite(sample_rate) and sample_rate >= 1e-3 * wanted):
        rates = f"a rate of {1e-3 * wanted:g} Hz or more to resample to {wanted:g} Hz"
        raise EvaluationError.expected(rates, sample_rate, name="sample_rate")


def default_fft_sizes(sample_rate: float) -> tuple[int, ...]:
    """Return 2048, 1024, 512 and 256 samples, the paper's, at 44.1 and 48 kHz, scaled for other rates (Hz).

    512, 256, 128 and 64 at 400 Hz.
    """
    return tuple(scaled_fft_size(size, sample_rate=sample_rate) for size in (2048, 1024, 512, 256))


def relative_stft_error(
    predicted: Sounds, truth: Sounds, *, sample_rate: float, fft_sizes: Sequence[int] | None = None
) -> PerContact:
    """Return the sums of absolute differences of STFT magnitudes, over the truth's sum, mean over FFT sizes.

    FFT sizes in samples, by default `default_fft_sizes`. Hann windows, hop a quarter of the FFT size, frames centered,
    silence beyond the ends. The truth's sum is the mean over all contacts given, so that the mean of the result is the
    ratio of the sums over all contacts: loud impacts weigh more than quiet ones. Raises EvaluationError where the truth
    is silent throughout.
    """
    validate(predicted, truth)
    error, sizes = torch.zeros(len(truth), dtype=torch.float64), fft_sizes or default_fft_sizes(sample_rate)
    for size in sizes:

        def sums(a: Sounds, b: Sounds, size: int = size) -> Float64[Tensor, "contacts 2"]:
            spectra = [magnitude_stft(sounds, fft_size=size, hop=max(1, size // 4)) for sounds in (a, b)]
            return torch.stack([(spectra[0] - spectra[1]).abs().sum(dim=(1, 2)), spectra[1].sum(dim=(1, 2))], dim=1)

        difference, weight = _blockwise(sums, predicted, truth).unbind(dim=1)
        if weight.sum() == 0.0:
            raise EvaluationError.expected("sounds that are not all silent", 0.0, got="silence", name="truth")
        error += difference / weight.mean()
    return error / len(sizes)


PAPER_FFT_SIZE, PAPER_HOP, PAPER_MELS, PAPER_FLOOR = 1024, 256, 80, 1e-5
"""Samples of the window and from frame to frame, and mel bands, at 44.1 and 48 kHz; the smallest mel magnitude, in the
sounds' unit.

The paper describes its metrics in words. This is the reading that its own values support. Sixty clips of Gaussian
white noise, 3 s at 48 kHz with peak one, against silence score L1 3.74 and ENV .305 in it, a ratio of 12.27 at any
level; the paper's rows for white noise have 3.774 and .305 (12.37), and 3.789 and .308 (12.30), where FFT sizes of
512 and 2048 would give 8.67 and 17.33. For L1-log the paper's 6.859 lies between what such noise scores against
eight ObjectFolder Real clips as recorded, 8.8, and scaled to peak one, 6.1, with triangles of height one on
magnitudes; on squared magnitudes it would be 12 to 15. It remains an inference: compare ratios with the paper's,
not absolute values."""


def spectrogram_distance(predicted: Sounds, truth: Sounds, *, sample_rate: float) -> PerContact:
    """Return the mean absolute difference of the STFT magnitudes, in the sounds' unit (L1).

    Magnitudes as `avmsf.modal.spectra` has them, unscaled.
    """
    validate(predicted, truth)
    size, step = (scaled_fft_size(each, sample_rate=sample_rate) for each in (PAPER_FFT_SIZE, PAPER_HOP))

    def distance(a: Sounds, b: Sounds) -> PerContact:
        spectra = [magnitude_stft(sounds, fft_size=size, hop=step) for sounds in (a, b)]
        return (spectra[0] - spectra[1]).abs().mean(dim=(1, 2))

    return _blockwise(distance, predicted, truth)


def log_mel_distance(predicted: Sounds, truth: Sounds, *, sample_rate: float) -> PerContact:
    """Return the mean absolute difference of the natural logarithms of mel magnitudes, in nepers (L1-log).

    HTK triangles of height one from 0 Hz to half the rate, `PAPER_MELS` of them at most; magnitudes below
    `PAPER_FLOOR`, in the sounds' unit, count as that.
    """
    validate(predicted, truth)
    sizes = PAPER_FFT_SIZE, PAPER_HOP, PAPER_MELS
    size, step, bands = (scaled_fft_size(each, sample_rate=sample_rate) for each in sizes)
    bands = min(bands, PAPER_MELS)
    filters = htk_filters(bands, fft_size=size, sample_rate=sample_rate)

    def mels(sounds: Float64[Tensor, "contacts samples"]) -> Float64[Tensor, "contacts mels frames"]:
        return torch.log(torch.clamp(filters @ magnitude_stft(sounds, fft_size=size, hop=step), min=PAPER_FLOOR))

    return _blockwise(lambda a, b: (mels(a) - mels(b)).abs().mean(dim=(1, 2)), predicted, truth)


def envelope_distance(predicted: Sounds, truth: Sounds, *, sample_rate: float) -> PerContact:
    """Return the root mean square difference of the Hilbert envelopes over time, in the sounds' unit (ENV).

    The sample rate makes no difference.
    """
    validate(predicted, truth)
    return _blockwise(lambda a, b: (envelope(a) - envelope(b)).square().mean(dim=1).sqrt(), predicted, truth)


def _expect_rows(sounds: Sounds, what: str) -> None:
    if sounds.ndim != 2:
        advice = "give a single sound as one row, sound[None]"
        raise EvaluationError.expected("sounds [contacts, samples]", list(sounds.shape), name=what, advice=advice)
    if sounds.numel() == 0:
        raise EvaluationError.expected("one contact and one sample or more", list(sounds.shape), name=what)


def _expect_numbers(sounds: Sounds, what: str, names: Sequence[str] | None) -> None:
    bad = torch.nonzero(~torch.isfinite(sounds))
    if len(bad):
        row, sample = bad[0].tolist()
        value = float(sounds[row, sample])
        got = f"{value} at sample {sample}" + ("" if names is None else f" of {names[row]}")
        raise EvaluationError.expected("finite samples", value, got=got, row=row, name=what)


def _blockwise(
    distance: Callable[[Tensor, Tensor], Tensor], predicted: Sounds, truth: Sounds
) -> Float64[Tensor, "contacts *figures"]:
    """Apply a distance that works row by row to a few rows at a time, in float64 and without gradients."""
    blocks = zip(torch.split(predicted.detach().cpu(), _BLOCK), torch.split(truth.detach().cpu(), _BLOCK), strict=True)
    return torch.cat([distance(a.double(), b.double()) for a, b in blocks])
