"""The training objective: multi-scale short-time spectra, of the whole sound and of its beginning (paper, eq. 14).

Autograd through a short-time transform with a hop of 64 samples keeps every frame of every resolution alive. The loss
is piecewise linear in the magnitudes, so its gradient is at hand as soon as a chunk of frames is: transform, take the
sign, transform back, overlap-add, forget. One autograd function does all of it in the forward pass. Torch takes a dozen
passes through memory for the comparison, which is most of what a fit does; on processors compiled loops compare and
overlap-add. On GPUs each call of torch costs more than its arithmetic: there one chunk holds a resolution.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Complex, Float, Float64
from torch import Tensor

from avmsf._utils.compiled import compiled

CHUNK_SAMPLES, CARD_CHUNK_SAMPLES = 1 << 19, 1 << 27
"""Samples of windowed frames held at once: near a processor's cache, or all frames in half a gigabyte of a card's."""
_MIN_POWER_RATIO = 1e-12
"""Power below which a magnitude counts as zero, over that of the target's largest sample times the window's energy: its
slope is taken as finite there. Recordings divided by their forces have samples of 1e-5, so the floor has to scale."""


@dataclass(frozen=True, eq=False)
class Resolution:
    """Recordings' magnitudes at one resolution."""

    magnitudes: Float[Tensor, "contacts frames bins"]
    norms: Float64[np.ndarray, " frames"]
    """What the distances in the frames are divided by: their sums over contacts and bins."""
    window: Float[Tensor, " size"]
    """What frames are multiplied by, as long as they are."""
    hop: int
    """Samples between frames."""
    floor: float
    """Least power that counts."""


@dataclass(frozen=True, eq=False)
class SpectralTarget:
    """Recordings to compare with: made once, used at every step."""

    resolutions: tuple[Resolution, ...]
    samples: int
    """Length of the sounds that are compared: those that are longer are cut."""


def spectral_target(
    sounds: Float[Tensor, "contacts samples"],
    *,
    fft_sizes: Sequence[int],
    hops: Sequence[int],
    samples: int | None = None,
) -> SpectralTarget:
    """Return the magnitudes of `sounds`, or of their first `samples`, at several resolutions (sizes in samples).

    Sizes are even, so that half a window lies before a frame's center. Hann windows, frames centered, silence beyond
    the ends, as in `avmsf.modal.spectra`.
    """
    cut = sounds[:, :samples]
    peak = float(cut.abs().max()) if cut.numel() else 0.0
    resolutions = []
    for size, hop in zip(fft_sizes, hops, strict=True):
        window = torch.hann_window(size, dtype=cut.dtype, device=cut.device)
        floor = max(_MIN_POWER_RATIO * peak**2 * float(window.square().sum()), torch.finfo(cut.dtype).tiny)
        frames = _padded(cut, size).unfold(1, size, hop)
        magnitudes = torch.empty(*frames.shape[:2], size // 2 + 1, dtype=cut.dtype, device=cut.device)
        for chunk in _chunks(frames):
            magnitudes[chunk] = _magnitude(torch.fft.rfft(frames[chunk] * window), floor)
        norms = magnitudes.sum((0, 2), dtype=torch.float64).cpu().numpy()
        resolutions.append(Resolution(magnitudes, norms, window, hop, floor))
    return SpectralTarget(tuple(resolutions), cut.shape[1])


def spectral_loss(
    sounds: Float[Tensor, "contacts samples"], target: SpectralTarget, *, first: int = 0, every: int = 1
) -> Float[Tensor, ""]:
    """Return the L1 distance of magnitudes over the target's norm, summed over resolutions (paper, eq. 14).

    Their L1 norms make the resolutions weigh alike and the loss read as a relative error; differentiable in `sounds`.
    Only frame `first` and `every` so many after it are compared: the mean of the losses from each first frame below
    `every` on is the loss of all frames, about, for an `every`th of the work each. Raises ValueError for other sounds
    than the target's, in number, or shorter ones.
    """
    contacts = len(target.resolutions[0].magnitudes)
    if len(sounds) != contacts or sounds.shape[1] < target.samples:
        raise ValueError(
            f"expected {contacts} sounds of {target.samples} samples or more, as the target's, got {len(sounds)} of "
            f"{sounds.shape[1]}"
        )
    loss: Float[Tensor, ""] = _SpectralL1.apply(  # type: ignore[no-untyped-call]
        sounds[:, : target.samples], target, first, every
    )
    return loss


class _SpectralL1(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, sounds: Float[Tensor, "contacts samples"], target: SpectralTarget, first: int, every: int
    ) -> Float[Tensor, ""]:
        widest = max(len(each.window) for each in target.resolutions)
        padded = _padded(sounds, widest)
        slope = torch.zeros_like(padded)
        loss = sounds.new_zeros(())
        compare, overlap_add = _compare_torch, _overlap_add_torch
        if sounds.device.type == "cpu":
            compare, overlap_add = _compare_numpy, _overlap_add_numpy
        for known in target.resolutions:
            size = len(known.window)
            # Short sounds may have fewer frames than are skipped.
            step = min(every, len(known.norms))
            start, stride = first % step, step * known.hop
            factor = 1 / max(float(known.norms[start::step].sum()), torch.finfo(sounds.dtype).tiny)
            margin = (widest - size) // 2
            before = margin + start * known.hop
            frames = padded[:, before : padded.shape[1] - margin].unfold(1, size, stride)
            for rows, part in _chunks(frames):
                spectra = torch.fft.rfft(frames[rows, part] * known.window)
                place = start + step * part.start
                loss.add_(compare(spectra, known.magnitudes[rows], known.floor, place, step), alpha=factor)
                if ctx.needs_input_grad[0]:
                    # From here on the spectra are the slope's.
                    slopes = torch.fft.irfft(spectra, size, norm="forward")
                    overlap_add(slope[rows, before + part.start * stride :], slopes, known.window, stride, 0.5 * factor)
        ctx.save_for_backward(slope[:, widest // 2 : widest // 2 + sounds.shape[1]])
        return loss

    @staticmethod
    def backward(ctx: Any, outer: Float[Tensor, ""]) -> tuple[Tensor, None, None, None]:
        # `create_graph=True`: the saved slope would count as a constant, and second derivatives would be wrong.
        if torch.is_grad_enabled():
            raise NotImplementedError("spectral_loss has first derivatives only: expected create_graph=False")
        (slope,) = ctx.saved_tensors
        return outer * slope, None, None, None


def _overlap_add_torch(into: Tensor, frames: Tensor, window: Tensor, hop: int, factor: float) -> None:
    """Add windowed frames times a factor, which begin at 0, hop, 2 hop, ..., to signals, in place."""
    count, size = frames.shape[1:]
    into = into[:, : (count - 1) * hop + size]
    # The transpose of cutting a signal into frames: one call, whatever the hop.
    with torch.enable_grad():
        signal = into.detach().requires_grad_()
        cut = signal.unfold(1, size, hop)
    into.add_(torch.autograd.grad(cut, signal, frames.mul_(window))[0], alpha=factor)


def _overlap_add_numpy(into: Tensor, frames: Tensor, window: Tensor, hop: int, factor: float) -> None:
    values = window.numpy()
    _overlap_add_compiled(into.numpy(), frames.numpy(), values * values.dtype.type(factor), hop)


@compiled()
@no_type_check
def _overlap_add_compiled(into, frames, window, hop):
    for contact in range(len(frames)):
        for frame in range(frames.shape[1]):
            start = frame * hop
            for sample in range(len(window)):
                into[contact, start + sample] += frames[contact, frame, sample] * window[sample]


def _padded(sounds: Float[Tensor, "contacts samples"], fft_size: int) -> Float[Tensor, "contacts padded"]:
    """Return the sounds between half windows of silence: frames are centered on the samples 0, hop, 2 hop, ..."""
    return torch.nn.functional.pad(sounds, (fft_size // 2, fft_size // 2))


def _chunks(frames: Float[Tensor, "contacts frames size"]) -> list[tuple[slice, slice]]:
    """Return contacts and frames that are transformed at once: several contacts, or a part of one's frames."""
    contacts, count, size = frames.shape
    most = max(1, (CHUNK_SAMPLES if frames.device.type == "cpu" else CARD_CHUNK_SAMPLES) // size)
    rows = max(1, most // count)
    return [
        (slice(row, min(contacts, row + rows)), slice(first, min(count, first + most)))
        for row in range(0, contacts, rows)
        for first in range(0, count, most)
    ]


def _magnitude(spectra: Complex[Tensor, "contacts frames bins"], floor: float) -> Float[Tensor, "contacts frames bins"]:
    """Return magnitudes of spectra; a power below `floor` counts as `floor`."""
    return spectra.abs().clamp_min_(math.sqrt(floor))


def _compare_torch(spectra: Tensor, target: Tensor, floor: float, first: int, every: int) -> Float[Tensor, ""]:
    """Return the L1 distance of magnitudes to the target's frames `first` + i `every`; turn `spectra` into its slope.

    The slope is doubled in the first and the last bin, which a one-sided inverse transform counts once, others twice.
    """
    found = _magnitude(spectra, floor)
    difference = found - target[:, first : first + every * spectra.shape[1] : every]
    distance = torch.linalg.vector_norm(difference, 1)
    spectra *= difference.sign_().div_(found)
    spectra[..., :: spectra.shape[2] - 1].mul_(2.0)
    return distance


def _compare_numpy(spectra: Tensor, target: Tensor, floor: float, first: int, every: int) -> Float[Tensor, ""]:
    known = target.numpy()
    return target.new_tensor(_compare_compiled(spectra.numpy(), known, known.dtype.type(floor), first, every))


# Not all of fastmath: a fit that diverges is known by what is not a number.
@compiled(fastmath={"reassoc", "contract"}, error_model="numpy")
@no_type_check
def _compare_compiled(spectra, target, floor, first, every):
    """Do what `_compare_torch` does, for arrays."""
    contacts, frames, bins = spectra.shape
    # Of the array's own kind, for a plain 1.0 would make float64 of all; and conditionals, which are vectorised where a
    # sign is not.
    zero, one = target.dtype.type(0), target.dtype.type(1)
    distance = 0.0
    for contact in range(contacts):
        for frame in range(frames):
            found, known = spectra[contact, frame], target[contact, first + every * frame]
            total = zero
            for bin in range(bins):
                real, imaginary = found[bin].real, found[bin].imag
                power = real * real + imaginary * imaginary
                magnitude = np.sqrt(floor if power < floor else power)
                difference = magnitude - known[bin]
                total += abs(difference)
                turn = (one if difference > zero else -one if difference < zero else zero) / magnitude
                found[bin] = complex(real * turn, imaginary * turn)
            found[0] *= one + one
            found[bins - 1] *= one + one
            distance += total
    return distance
