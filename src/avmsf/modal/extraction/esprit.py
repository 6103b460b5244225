"""Candidate modes by matrix pencils in subbands, all recordings at once.

A sum of damped exponentials keeps its poles when it is filtered and decimated, so each narrow band can be searched on
its own: the Hankel matrices of all recordings share one signal subspace, and the rotation that takes its upper rows to
its lower rows has the poles as eigenvalues (matrix pencil; ESPRIT). A band holds about the same number of samples
whatever its width, and the search runs over several lengths of the sounds: the whole, for doublets that beat slowly,
in narrow bands, and ever shorter beginnings, for modes that die early, in ever wider ones.
"""

import math

import torch
from jaxtyping import Complex, Complex128, Float, Float64
from torch import Tensor

from avmsf.modal.modes import ModalBank

_DEPTH = 512
"""Decimated samples in a band: enough to tell modes apart, few enough for small eigenproblems."""
SHORTEST = 256
"""Samples of the shortest beginning that is still searched."""
_EDGE = 0.2
"""Part of a band on either side over which its filter fades: what lies there belongs to the neighbors."""
_RINGING = 5
"""Decimated samples after the onset in which the band filter itself still rings."""
_ABOVE_NOISE = 10.0
"""Eigenvalues this far above the noise's belong to the signal. Low, for what is wrongly let in is sifted later."""

_ORDERS = range(2, 33, 2)
"""Model orders of a stability diagram, poles in a band."""
_FALL = 5.0
"""Nepers by which a mode falls over the beginning that it is looked for in, at least: less than a hundredth is left."""
_SHALLOW = 128
"""Samples of the band that a mode is looked for in: a third of them exceeds the highest order."""
_STABLE = 0.25
"""Distance of a pole from the mode's, over its damping, at which it counts as found. Stability diagrams allow 1 % of
frequency and 5 % of damping as a rule (B. Peeters and G. De Roeck, Mechanical Systems and Signal Processing 13(6),
1999); here modes may lie closer than 1 % of their frequency, and the width sets the scale."""


def candidates(
    sounds: Float[Tensor, "contacts samples"],
    noise: Float[Tensor, "contacts bins"],
    *,
    sample_rate: float,
    lowest: float,
    significance: float,
) -> ModalBank:
    """Return everything that may be a mode between `lowest`, Hz, and half the rate.

    More than the object has: one mode may appear at several lengths, noise may look like modes, and steady hum appears
    as a mode that falls by a tenth of a neper over the whole sound, too little to measure a damping by. `noise` is its
    power in evenly spaced bands up to half the rate; bands whose spectrum nowhere reaches `significance` times it, mean
    over the sounds, are passed over.
    """
    found = [torch.zeros(0, dtype=torch.complex128)]
    samples = sounds.shape[1]
    while samples >= SHORTEST:
        exponents = _search(sounds[:, :samples], noise, sample_rate, lowest, significance)
        slowest = 0.1 * sample_rate / samples
        if samples == sounds.shape[1]:
            exponents = torch.complex(exponents.real.clamp_max(-slowest), exponents.imag)
        found.append(exponents[exponents.real <= -slowest])
        samples //= 4
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
            kept = frequency >= bottom + _EDGE * width - overlap
            kept &= frequency < bottom + (1 - _EDGE) * width + overlap
            kept &= (frequency >= lowest) & (frequency < sample_rate / 2)
            # What grows is noise; what dies faster than the band is wide is an artefact of its filter.
            kept &= (damping > -sample_rate / samples) & (damping < width)
            found.append(torch.complex(-damping, 2 * math.pi * frequency)[kept])
        bottom += (1 - 2 * _EDGE) * width
    return torch.cat(found)


def stable_orders(
    sounds: Float[Tensor, "contacts samples"], bank: ModalBank, *, sample_rate: float
) -> Float64[Tensor, " modes"]:
    """Return the part of the model orders at which each mode is found again, from 0 to 1: its stability diagram.

    Orders from 2 to 32 of a matrix pencil in a band about the mode, in a beginning of the sounds over which it dies.
    All sounds count alike, however loud.
    """
    stable = torch.zeros(len(bank), dtype=torch.float64)
    sounds = sounds.double() - sounds.double().mean(1, keepdim=True)
    sounds = torch.nn.functional.normalize(sounds, dim=1)
    samples = sounds.shape[1]
    lengths = [samples]
    while lengths[-1] >= 2 * SHORTEST:
        lengths.append(lengths[-1] // 2)
    wanted = _FALL * sample_rate / bank.damping
    # The shortest beginning that is long enough, or the whole.
    chosen = (torch.tensor(lengths)[:, None] >= wanted).sum(0).clamp_min(1) - 1
    for place, length in enumerate(lengths):
        padded = 1 << (2 * length - 1).bit_length()
        size = min(round(_SHALLOW * padded / length), padded // 2)
        fade = torch.hann_window(size, periodic=False, dtype=torch.float64).sqrt()
        modes = torch.nonzero(chosen == place).flatten()
        spectrum = torch.fft.rfft(sounds[:, :length], padded) if len(modes) else None
        for mode in modes.tolist():
            assert spectrum is not None
            first = round(float(bank.frequency[mode]) * padded / sample_rate) - size // 2
            index = torch.arange(first, first + size)
            inside = (index >= 0) & (index < padded // 2)
            band = torch.fft.ifft(spectrum[:, index.clamp(0, padded // 2 - 1)] * (inside * fade))
            band = band[:, _RINGING : size * length // padded]
            span = band.shape[1] // 3
            _, vectors = _subspace(band, span)
            turn = 2 * math.pi * (bank.frequency[mode] - first * sample_rate / padded)
            pole = torch.exp(torch.complex(-bank.damping[mode], turn) * (padded / size / sample_rate))
            reach = _STABLE * bank.damping[mode] * padded / size / sample_rate
            # Sounds too short for the higher orders have none of them.
            orders = [order for order in _ORDERS if order < span]
            near = [bool((torch.log(_rotation(vectors[:, :order]) / pole).abs() < reach).any()) for order in orders]
            stable[mode] = sum(near) / len(_ORDERS)
    return stable


def _poles(band: Complex[Tensor, "contacts times"]) -> Complex128[Tensor, " poles"]:
    """Return the poles shared by complex signals, by the rotational invariance of their signal subspace."""
    span = band.shape[1] // 3
    values, vectors = _subspace(band, span)
    noise = values[span // 2 :].clamp_min(float(values[0]) * 1e-13).median()
    order = min(int((values > _ABOVE_NOISE * noise).sum()), span // 2)
    return _rotation(vectors[:, :order])


def _subspace(
    band: Complex[Tensor, "contacts times"], span: int
) -> tuple[Float64[Tensor, " span"], Complex128[Tensor, "span span"]]:
    """Return eigenvalues and eigenvectors of the signals' correlation, greatest first.

    It is the sum of x x^H over all runs x of `span` samples: H^T H* of the signals' Hankel matrices H.
    """
    signals, times = band.to(torch.complex128), band.shape[1]
    correlation = torch.zeros(span, span, dtype=torch.complex128)
    first = torch.fft.fft(signals[:, : times - span + 1], times).conj() * torch.fft.fft(signals)
    correlation[:, 0] = torch.fft.ifft(first.sum(0))[:span]
    correlation[0] = correlation[:, 0].conj()
    # From one entry to the next along a diagonal one product leaves the sum and one enters it.
    enters, leaves = signals[:, times - span + 1 :], signals[:, : span - 1]
    change = enters.T @ enters.conj() - leaves.T @ leaves.conj()
    for row in range(span - 1):
        correlation[row + 1, 1:] = correlation[row, :-1] + change[row]
    values, vectors = torch.linalg.eigh(correlation)
    return values.flip(0), vectors.flip(1)


def _rotation(subspace: Complex128[Tensor, "span order"]) -> Complex128[Tensor, " poles"]:
    """Return the eigenvalues of the rotation that takes a signal subspace's upper rows to its lower ones."""
    # By normal equations, for the upper rows of orthonormal columns are all but orthonormal: torch's complex lstsq
    # rounds otherwise from call to call, and a selection among hundreds of candidates makes that visible.
    upper, lower = subspace[:-1], subspace[1:]
    poles = torch.linalg.eigvals(torch.linalg.solve(upper.mH @ upper, upper.mH @ lower))
    return poles[torch.isfinite(poles.abs()) & (poles != 0)]
