"""Candidate modes by matrix pencils in subbands, all recordings at once.

A sum of damped exponentials keeps its poles when it is filtered and decimated, so each narrow band can be searched on
its own: the Hankel matrices of all recordings share one signal subspace, and the rotation that takes its upper rows to
its lower rows has the poles as eigenvalues (matrix pencil; ESPRIT). A band holds about the same number of samples
whatever its width, and the search runs over several lengths of the sounds: the whole, for doublets that beat slowly,
in narrow bands, and ever shorter beginnings, for modes that die early, in ever wider ones.
"""

import math
from typing import no_type_check

import torch
from jaxtyping import Complex, Complex128, Float
from torch import Tensor

from avmsf._utils.compiled import compiled
from avmsf.modal.modes import ModalBank

_DEPTH = 512
"""Decimated samples in a band: enough to tell modes apart, few enough for small eigenproblems."""
SHORTEST = 256
"""Samples of the shortest beginning that is still searched."""
_SHORTENING = 4
_EDGE = 0.2
"""Part of a band on either side over which its filter fades: what lies there belongs to the neighbors."""
_RINGING = 5
"""Decimated samples after the onset in which the band filter itself still rings."""
_LEAST_FALL = 0.1
"""Nepers over its length by which a sound must fall for its damping to be measured at all."""
_ABOVE_NOISE = 10.0
"""Eigenvalues this far above the noise's belong to the signal. Low, for what is wrongly let in is sifted later."""


def candidates(
    sounds: Float[Tensor, "contacts samples"],
    noise: Float[Tensor, "contacts bins"],
    *,
    sample_rate: float,
    lowest: float,
    significance: float,
) -> ModalBank:
    """Return everything that may be a mode between `lowest`, Hz, and half the rate.

    More than the object has: one mode may appear at several lengths, noise may look like modes, and steady hum
    appears as a mode that falls by a tenth of a neper over the whole sound. `noise` is its
    power in evenly spaced bands up to half the rate; bands whose spectrum nowhere reaches `significance` times it,
    mean over the sounds, are passed over.
    """
    found = [torch.zeros(0, dtype=torch.complex128)]
    samples = sounds.shape[1]
    while samples >= SHORTEST:
        exponents = _search(sounds[:, :samples], noise, sample_rate, lowest, significance)
        slowest = _LEAST_FALL * sample_rate / samples
        if samples == sounds.shape[1]:
            exponents = torch.complex(exponents.real.clamp_max(-slowest), exponents.imag)
        found.append(exponents[exponents.real <= -slowest])
        samples //= _SHORTENING
    exponents = torch.cat(found)
    return ModalBank(exponents.imag / (2 * math.pi), -exponents.real)


def _search(
    sounds: Float[Tensor, "contacts samples"],
    noise: Float[Tensor, "contacts bins"],
    sample_rate: float,
    lowest: float,
    significance: float,
) -> Complex128[Tensor, " found"]:
    """Return the exponents -d + 2 pi i f found band by band in sounds of one length."""
    samples = sounds.shape[1]
    padded = 1 << (2 * samples - 1).bit_length()
    spectrum = torch.fft.rfft(sounds, padded)[:, :-1]
    # Band and bin of the noise's own spectrum that each bin of this one lies in.
    place = torch.arange(padded // 2) * (noise.shape[1] - 1) // (padded // 2)
    # Seen through a smooth window, or the onset's own edge would stand above the noise in every band. What has died
    # before the window opens stands out in shorter beginnings.
    window = torch.hann_window(samples, dtype=sounds.dtype)
    power = torch.fft.rfft(sounds * window, padded)[:, :-1].abs().square() / window.square().sum()
    above = (power / noise[:, place]).mean(0)
    size = min(1 << round(math.log2(_DEPTH * padded / samples)), padded // 2)
    width = size * sample_rate / padded
    fade = torch.sin(torch.linspace(0, math.pi / 2, round(_EDGE * size))).square()
    taper = torch.cat([fade, torch.ones(size - 2 * len(fade)), fade.flip(0)])
    found = [torch.zeros(0, dtype=torch.complex128)]
    bottom = lowest - _EDGE * width
    while bottom + _EDGE * width < sample_rate / 2:
        first = round(bottom * padded / sample_rate)
        index = torch.arange(first, first + size)
        inside = (index >= 0) & (index < padded // 2)
        index = index.clamp(0, padded // 2 - 1)
        if float(above[index].max()) > significance:
            band = torch.fft.ifft(spectrum[:, index] * (inside * taper))
            poles = _poles(band[:, _RINGING : size * samples // padded])
            turns = torch.remainder(torch.angle(poles) / (2 * math.pi), 1.0)
            frequency = turns * width + first * sample_rate / padded
            damping = -torch.log(poles.abs()) * width
            overlap = 0.02 * width
            kept = (frequency >= bottom + _EDGE * width - overlap) & (
                frequency < bottom + (1 - _EDGE) * width + overlap
            )
            kept &= (frequency >= lowest) & (frequency < sample_rate / 2)
            # What grows is noise; what dies faster than the band is wide is an artefact of its filter.
            kept &= (damping > -sample_rate / samples) & (damping < width)
            found.append(torch.complex(-damping, 2 * math.pi * frequency)[kept])
        bottom += (1 - 2 * _EDGE) * width
    return torch.cat(found)


def _poles(band: Complex[Tensor, "contacts times"]) -> Complex128[Tensor, " poles"]:
    """Return the poles shared by complex signals, by the rotational invariance of their signal subspace."""
    span = band.shape[1] // 3
    values, vectors = torch.linalg.eigh(_correlation(band.to(torch.complex128), span))
    values, vectors = values.flip(0), vectors.flip(1)
    noise = values[span // 2 :].clamp_min(float(values[0]) * 1e-13).median()
    subspace = vectors[:, : min(int((values > _ABOVE_NOISE * noise).sum()), span // 2)]
    # By normal equations, for the upper rows of orthonormal columns are all but orthonormal: torch's complex lstsq
    # rounds otherwise from call to call, and a selection among hundreds of candidates makes that visible.
    upper, lower = subspace[:-1], subspace[1:]
    poles = torch.linalg.eigvals(torch.linalg.solve(upper.mH @ upper, upper.mH @ lower))
    return poles[torch.isfinite(poles.abs()) & (poles != 0)]


def _correlation(band: Complex128[Tensor, "contacts times"], span: int) -> Complex128[Tensor, "span span"]:
    """Return the sum of x x^H over all runs x of `span` samples: H^T H* of the signals' Hankel matrices H."""
    whole = torch.zeros(span, span, dtype=band.dtype)
    _correlate(band.numpy(), band.conj().resolve_conj().numpy(), whole.numpy())
    return whole


@compiled(error_model="numpy", nogil=True, fastmath={"reassoc", "contract"})
@no_type_check
def _correlate(band, conjugate, whole):
    """Write what `_correlation` returns into zeros.

    From one entry to the next along a diagonal one product leaves the sum and one enters it, so that only the first
    row is summed in full.
    """
    contacts, times = band.shape
    span = len(whole)
    runs = times - span + 1
    for contact in range(contacts):
        for column in range(span):
            total = 0.0j
            for time in range(runs):
                total += band[contact, time] * conjugate[contact, column + time]
            whole[0, column] += total
        for row in range(span - 1):
            enters, leaves = band[contact, runs + row], band[contact, row]
            for column in range(row, span - 1):
                one, other = conjugate[contact, runs + column], conjugate[contact, column]
                whole[row + 1, column + 1] += enters * one - leaves * other
    for row in range(1, span):
        for column in range(row, span):
            whole[row, column] += whole[row - 1, column - 1]
            whole[column, row] = whole[row, column].conjugate()
    for column in range(1, span):
        whole[column, 0] = whole[0, column].conjugate()
