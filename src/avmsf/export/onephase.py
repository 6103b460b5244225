"""One signed amplitude a mode, for formats in which all modes start alike."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Float64, Int
from torch import Tensor

from avmsf.export.sampledfield import SampledField
from avmsf.modal.phase import common_phase
from avmsf.modal.spectra import magnitude_stft
from avmsf.modal.synthesis import synthesize

_JUDGED = 8
"""Points at which an export is compared with the field."""
_WINDOW = 0.04
"""Seconds in which levels are compared: about as finely as one hears."""
_FLOOR = 1e-3
"""Magnitude, over the largest, below which nothing is compared: 60 dB."""


@dataclass(frozen=True)
class Deviation:
    """How far an export's sounds are from the field's, at a few points."""

    waveform: float
    """Largest difference of samples, over the loudest sample."""
    spectrum_db: float
    """Mean difference of short-time magnitude spectra, dB, weighted by the field's energy."""


def signed_amplitudes(field: SampledField) -> Float32[Tensor, "points modes"]:
    """Return how strongly each mode sounds at each point, positive or negative, whatever its phase.

    The size is that of sine and cosine together, so that no mode gets louder or fainter; the sign is that of the part
    along the phase that all points agree on best, so that it changes where the mode has a node.
    """
    amplitude = torch.complex(field.sine.double(), field.cosine.double())
    phase = common_phase(field.sine, field.cosine)
    along = (amplitude * torch.polar(torch.ones_like(phase), -phase)).real
    return torch.where(along < 0, -amplitude.abs(), amplitude.abs()).float()


def shared_dampings(field: SampledField) -> Float64[Tensor, " modes"]:
    """Return one damping a mode, 1/s: its mean over points by the energy with which it sounds there."""
    if field.shared_damping:
        return field.damping
    energy = field.sine.double().square() + field.cosine.double().square()
    total = energy.sum(0)
    weights = torch.where(total > 0, energy / total.clamp(min=1e-300), 1.0 / len(field))
    return (weights * field.damping).sum(0)


def deviation(
    field: SampledField,
    *,
    sine: Float32[Tensor, "points modes"] | None,
    cosine: Float32[Tensor, "points modes"] | None,
    damping: Float64[Tensor, "*points modes"],
) -> Deviation:
    """Return by how much these modes without noise miss the field at a few points."""
    rows = field.spread(_JUDGED)
    zero = torch.zeros(len(rows), len(field.frequency))
    heard = synthesize(
        zero if sine is None else sine[rows],
        field.frequency,
        damping if damping.ndim == 1 else damping[rows],
        samples=field.samples,
        sample_rate=field.sample_rate,
        quadrature=zero if cosine is None else cosine[rows],
    )
    true = field.render(rows)
    return Deviation(_relative(heard, true), _apart_db(heard, true, field.sample_rate))


def importance(field: SampledField, damping: Float64[Tensor, " modes"]) -> Int[Tensor, " modes"]:
    """Return the modes' rows, the one of most energy in all blows first."""
    energy = (field.sine.double().square() + field.cosine.double().square()).sum(0) / damping
    return torch.argsort(energy, descending=True, stable=True)


def _relative(heard: Tensor, true: Tensor) -> float:
    peak = float(true.abs().max())
    return float((heard - true).abs().max()) / peak if peak > 0 else 0.0


def _apart_db(
    heard: Float32[Tensor, "contacts samples"], true: Float32[Tensor, "contacts samples"], sample_rate: float
) -> float:
    size = max(4, 2 ** round(math.log2(_WINDOW * sample_rate)))
    found, expected = (magnitude_stft(each, fft_size=size, hop=size // 4) for each in (heard, true))
    floor, energy = _FLOOR * float(expected.max()), expected.square()
    if floor == 0:
        return 0.0
    apart = 20.0 * torch.log10((found + floor) / (expected + floor)).abs()
    return float((energy * apart).sum() / energy.sum())
