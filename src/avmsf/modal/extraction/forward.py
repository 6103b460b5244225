"""Forward selection among candidate modes by orthogonal least squares, in one compiled pass."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float64
from torch import Tensor

from avmsf._utils.compiled import compiled

_MIN_INDEPENDENT_AREA = 1e-6
"""Part of a candidate's (sine, cosine) area that the chosen ones must leave for it to count as another mode."""


def choose(
    gram: Float64[Tensor, "two_modes two_modes"],
    products: Float64[Tensor, "contacts 2 modes"],
    noise: Float64[Tensor, "contacts modes"],
    given: Bool[Tensor, " modes"],
    *,
    significance: float,
    reach: float,
) -> Float64[Tensor, " modes"]:
    """Return the energy of all sounds that each candidate explained when it was chosen, zero if never.

    The one that explains most of what the ones before it left is next, until it explains less than `reach` times what
    the best did; one that explains less than `significance` times what it would of noise, mean over the sounds, is
    never. `gram` and `products` are the inner products of all sines and then all cosines with each other and with the
    sounds, `noise` its power where each candidate lies. The `given` ones have been chosen before.
    """
    modes = len(given)
    # Each mode's sine and cosine side by side.
    inner = gram.reshape(2, modes, 2, modes).permute(1, 0, 3, 2).reshape(2 * modes, 2 * modes).contiguous()
    left = products.permute(2, 1, 0).contiguous()
    chosen, done = np.zeros(modes), np.zeros(modes, dtype=np.bool_)
    # Numbers to work with: arrays that are made in the loops themselves make them slow to compile.
    scratch = np.empty(modes), np.empty((4, 2 * modes)), np.empty((2, products.shape[0]))
    energies = left.numpy(), noise.T.contiguous().numpy()
    _choose(inner.numpy(), *energies, given.numpy(), significance, reach, *scratch, done, chosen)
    return gram.new_tensor(chosen)


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _choose(inner, products, noise, given, significance, reach, whole, rows, own, done, chosen):
    """Do what `choose` says, and leave of `inner` and `products` what the chosen ones do not span."""
    modes, _, contacts = products.shape
    for mode in range(modes):
        whole[mode] = _area(inner, mode)
    for mode in range(modes):
        if given[mode]:
            done[mode] = True
            if _area(inner, mode) > _MIN_INDEPENDENT_AREA * whole[mode]:
                _eliminate(mode, inner, products, done, rows, own)
    greatest = 0.0
    for _ in range(modes):
        # No mode yet; a literal number would have all that is called with it compiled twice.
        best, most = modes, reach * greatest
        for mode in range(modes):
            area = _area(inner, mode)
            # What the chosen ones span already cannot be judged: only rounding is left of it.
            if done[mode] or not area > _MIN_INDEPENDENT_AREA * whole[mode]:
                continue
            sine, cosine = 2 * mode, 2 * mode + 1
            crossed = inner[sine, cosine] + inner[cosine, sine]
            total, ratio = 0.0, 0.0
            for contact in range(contacts):
                one, other = products[mode, 0, contact], products[mode, 1, contact]
                energy = inner[cosine, cosine] * one * one - crossed * one * other + inner[sine, sine] * other * other
                total += energy / area
                ratio += energy / area / noise[mode, contact]
            if ratio > 2 * contacts * significance and total > most:
                best, most = mode, total
        if best == modes:
            break
        chosen[best], greatest, done[best] = most, max(greatest, most), True
        _eliminate(best, inner, products, done, rows, own)


@compiled(error_model="numpy", nogil=True)
@no_type_check
def _area(inner, mode):
    """Return the squared area that a mode's sine and cosine span."""
    sine, cosine = 2 * mode, 2 * mode + 1
    return inner[sine, sine] * inner[cosine, cosine] - inner[sine, cosine] * inner[cosine, sine]


@compiled(error_model="numpy", nogil=True, fastmath={"contract"})
@no_type_check
def _eliminate(mode, inner, products, done, rows, own):
    """Make all modes that are not done orthogonal to one."""
    sine, cosine = 2 * mode, 2 * mode + 1
    area = _area(inner, mode)
    first, second, leading, following = rows[0], rows[1], rows[2], rows[3]
    # Of the mode's own two by two matrix the inverse, times its two rows.
    for row in range(len(inner)):
        one, other = inner[sine, row], inner[cosine, row]
        first[row] = (inner[cosine, cosine] * one - inner[sine, cosine] * other) / area
        second[row] = (inner[sine, sine] * other - inner[cosine, sine] * one) / area
        leading[row], following[row] = inner[row, sine], inner[row, cosine]
    for contact in range(own.shape[1]):
        own[0, contact], own[1, contact] = products[mode, 0, contact], products[mode, 1, contact]
    for row in range(len(inner)):
        if done[row // 2]:
            continue
        one, other = leading[row], following[row]
        for column in range(len(inner)):
            inner[row, column] -= one * first[column] + other * second[column]
        for contact in range(own.shape[1]):
            products[row // 2, row % 2, contact] -= first[row] * own[0, contact] + second[row] * own[1, contact]
