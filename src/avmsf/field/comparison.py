"""Spectra of frames against known magnitudes, and the way to less of a difference, in one pass over them.

Torch takes a dozen passes, each through memory: on processors that is most of what a fit does. There a compiled loop
does it; elsewhere torch, with the same result.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from avmsf.compiled import compiled


def magnitude(spectra: Complex[Tensor, "contacts frames bins"], floor: float) -> Float[Tensor, "contacts frames bins"]:
    """Return magnitudes of spectra; a power below `floor` counts as `floor`."""
    # Torch's abs() of a complex tensor guards against overflow at three times the cost.
    parts = torch.view_as_real(spectra)
    return torch.addcmul(parts[..., 0].square(), parts[..., 1], parts[..., 1]).clamp_min_(floor).sqrt_()


def compare(
    spectra: Complex[Tensor, "contacts frames bins"],
    target: Float[Tensor, "contacts _frames bins"],
    floor: float,
    *,
    first: int,
    every: int,
) -> Float[Tensor, ""]:
    """Return the L1 distance of magnitudes to the target's frames `first` + i `every`; turn `spectra` into its slope.

    A power below `floor` counts as `floor`. The slope, by real and imaginary part, is doubled in the first and the last
    bin: a one-sided inverse transform counts those once and all others twice.
    """
    if spectra.device.type == "cpu":
        known = target.numpy()
        return target.new_tensor(_in_one_pass(spectra.numpy(), known, known.dtype.type(floor), first, every))
    return _by_torch(spectra, target, floor, first, every)


def _by_torch(
    spectra: Complex[Tensor, "contacts frames bins"],
    target: Float[Tensor, "contacts _frames bins"],
    floor: float,
    first: int,
    every: int,
) -> Float[Tensor, ""]:
    found = magnitude(spectra, floor)
    difference = found - target[:, first : first + every * spectra.shape[1] : every]
    distance = difference.abs().sum()
    spectra *= difference.sign_().div_(found)
    spectra[..., 0] *= 2.0
    spectra[..., -1] *= 2.0
    return distance


# Not all of fastmath: a fit that diverges is known by what is not a number.
@compiled(fastmath={"reassoc", "contract"}, error_model="numpy")
@no_type_check
def _in_one_pass(spectra, target, floor, first, every):
    """Do what `_by_torch` does, for arrays."""
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
