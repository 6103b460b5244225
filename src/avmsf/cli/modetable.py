"""Modes as a table: what `avmsf modes` and `avmsf show` print."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from avmsf.modal.bank import ModalBank
from avmsf.modal.extraction.extract import Extraction

_HEARD = 4.0
"""An amplitude this many times the standard deviation of one phase under noise: noise reaches it once in 3000
(exp(-4^2 / 2))."""


@dataclass(frozen=True)
class ModeRow:
    """One mode, as plain values."""

    frequency_hertz: float
    damping_per_second: float
    t60_seconds: float
    """Time in which it falls by 60 dB, ln(1000) / damping."""
    level_db: float
    """Root mean square of its amplitude over recordings or points, against the strongest mode's."""


def mode_rows(bank: ModalBank, level_db: Float[Tensor, " modes"]) -> list[ModeRow]:
    """Return the modes in the bank's order."""
    columns = (bank.frequency.tolist(), bank.damping.tolist(), level_db.tolist())
    return [
        ModeRow(frequency, damping, math.log(1000) / damping, level)
        for frequency, damping, level in zip(*columns, strict=True)
    ]


def levels(amplitudes: Float[Tensor, "contacts modes"]) -> Float[Tensor, " modes"]:
    """Return each mode's root mean square amplitude against the strongest mode's, dB."""
    size = amplitudes.square().mean(0).sqrt()
    floor = torch.finfo(size.dtype).tiny
    return 20 * torch.log10((size / size.max().clamp_min(floor)).clamp_min(1e-10))


def amplitudes(extraction: Extraction) -> Float[Tensor, "contacts modes"]:
    """Return the modes' amplitudes in each recording, whatever their phase."""
    return torch.hypot(extraction.gains, extraction.quadrature)


def heard_in(extraction: Extraction, *, sample_rate: float, samples: int) -> list[int]:
    """Return in how many recordings each mode stands clear of the noise.

    A least-squares amplitude of a decaying sine whose samples have the square sum E scatters in white noise of standard
    deviation s by s / sqrt(E) in phase and in quadrature; E is rate (1 - exp(-2 d T)) / (4 d). Four times that counts
    as heard, with s the residual's magnitude at the mode.
    """
    bank, magnitude = extraction.bank, extraction.residual.magnitude
    energy = sample_rate * -torch.expm1(-2 * bank.damping * samples / sample_rate) / (4 * bank.damping)
    place = torch.round(bank.frequency / (sample_rate / 2) * (len(magnitude) - 1)).long()
    scatter = magnitude.double()[place] / energy.sqrt()
    return (amplitudes(extraction) > _HEARD * scatter).sum(0).tolist()
