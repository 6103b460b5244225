"""Real signed amplitudes, for formats in which all modes have one phase."""

import math
from dataclasses import replace

import torch
from jaxtyping import Complex64, Float32, Float64
from torch import Tensor

from avmsf.export.sampled_field import SampledField
from avmsf.modal.modes import common_phase
from avmsf.modal.spectra import magnitude_stft


def signed_amplitudes(field: SampledField) -> Float32[Tensor, "points modes"]:
    """Return a real amplitude of each mode at each point, without its phase.

    It is the magnitude of sine and cosine part, so that levels do not change, with the sign of the projection on the
    phase that is common to all points, so that it changes at the mode's nodal lines.
    """
    amplitude = field.gains.to(torch.complex128)
    phase = common_phase(amplitude)
    along = (amplitude * torch.polar(torch.ones_like(phase), -phase)).real
    return torch.where(along < 0, -amplitude.abs(), amplitude.abs()).float()


def shared_dampings(field: SampledField) -> Float64[Tensor, " modes"]:
    """Return one damping for each mode, 1/s: the mean over points, weighted by the mode's energy there."""
    if field.shared_damping:
        return field.damping
    total = field.power.sum(0)
    weights = torch.where(total > 0, field.power / total.clamp(min=1e-300), 1.0 / len(field))
    return (weights * field.damping).sum(0)


def approximation_error(
    field: SampledField, amplitude: Complex64[Tensor, "points modes"], damping: Float64[Tensor, "*points modes"]
) -> tuple[float, float]:
    """Return how far modes of amplitudes sine + i cosine, without noise, are from the field at a few points.

    The largest difference of samples, relative to the largest sample; and the mean difference of short-time magnitude
    spectra, dB, weighted by the field's energy.
    """
    rows = field.spread(8)
    rendered = replace(field.without_noise(), gains=amplitude, damping=damping).render(rows)
    reference = field.render(rows)
    peak = float(reference.abs().max())
    if peak == 0:
        return 0.0, 0.0
    # Windows of about 40 ms: the temporal resolution of hearing.
    size = max(4, 2 ** round(math.log2(0.04 * field.sample_rate)))
    found, expected = (magnitude_stft(each, fft_size=size, hop=size // 4) for each in (rendered, reference))
    # What is 60 dB below the largest magnitude, or more, does not count.
    floor, energy = 1e-3 * float(expected.max()), expected.square()
    difference = 20.0 * torch.log10((found + floor) / (expected + floor)).abs()
    return float((rendered - reference).abs().max()) / peak, float((energy * difference).sum() / energy.sum())
