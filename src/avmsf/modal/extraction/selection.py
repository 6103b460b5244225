"""Which candidates are modes: forward selection by explained energy, then removal of what the rest explains as well.

Forward selection is that by orthogonal least squares, in one compiled pass.
"""

import math
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.special import gammainccinv
from torch import Tensor

from avmsf._utils.compiled import compiled
from avmsf.modal.extraction.least_squares import NormalEquations
from avmsf.modal.inner_products import gram, own_gram, poles_of, project
from avmsf.modal.modes import ModalBank
from avmsf.modal.residual_noise import noise_at

_CHUNK, _SHARED = 120, 30
"""Candidates judged together, in order of frequency, and how many of them the next chunk judges again."""
_MIN_APART = 0.01
"""Least part of a mode that the others must not span: with less, gains of large and opposite modes would cancel."""
_MERGED_WIDTHS = 0.03
"""Candidates closer than this part of their width, with dampings as close, are one."""
_MIN_INDEPENDENT_AREA = 1e-6
"""Part of a candidate's (sine, cosine) area that the chosen ones must leave for it to count as another mode."""
_MAX_NEIGHBORS = 30
"""Kept candidates just below a new one among which it may find its double."""


def merge(bank: ModalBank, *, duration: float) -> ModalBank:
    """Return the candidates by frequency, without those that repeat another: nearer than they could be resolved.

    A mode's width is its damping over 2 pi, at least what `duration` seconds resolve.
    """
    bank = bank.take(torch.argsort(bank.frequency))
    ascending, rates = bank.frequency.tolist(), bank.damping.tolist()

    def repeats(row: int, other: int) -> bool:
        narrow = max(min(rates[row], rates[other]), 1 / duration) / (2 * math.pi)
        return (
            ascending[row] - ascending[other] < _MERGED_WIDTHS * narrow
            and abs(math.log(rates[row] / rates[other])) < _MERGED_WIDTHS
        )

    kept: list[int] = []
    for row in range(len(ascending)):
        if not any(repeats(row, other) for other in kept[-_MAX_NEIGHBORS:]):
            kept.append(row)
    return bank.take(torch.tensor(kept, dtype=torch.long))


def chance_ratio(contacts: int, *, trials: int) -> float:
    """Return how many times its mean the energy that a mode explains of white noise is at most, of `trials` modes.

    A mode has two amplitudes in each of the recordings, so the energy is chi-squared with twice as many degrees of
    freedom; exceeded once in ten searches by chance.
    """
    return float(gammainccinv(contacts, 0.1 / trials)) / contacts


Measured = tuple[Float64[Tensor, "contacts 2 candidates"], Float64[Tensor, "contacts candidates"]]
"""Inner products of sounds with sines and cosines, and the noise's power where each of them lies."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Decides which candidates are modes of sounds."""

    sounds: Float64[Tensor, "contacts samples"]
    noise: Float[Tensor, "contacts bins"]
    """Power of the noise in evenly spaced bands up to half the rate."""
    sample_rate: float
    significance: float
    """Energy that a mode has to explain, mean over the sounds, over what it would of noise."""
    count: int
    """Maximum number of modes."""

    def measure(self, bank: ModalBank) -> Measured:
        """Return what the sounds and their noise have to do with the modes of `bank`."""
        products, _ = project(self.sounds, poles_of(bank, self.sample_rate))
        return products.reshape(len(self.sounds), 2, len(bank)), noise_at(self.noise, bank, self.sample_rate)

    def select(self, known: ModalBank, found: ModalBank, measured: Measured, *, range_db: float) -> ModalBank:
        """Return `known` and up to `count` of `found`: those that explain most of what is left, next to each other.

        `measured` is that of `found`. A candidate counts only when what it explains is significant, and within
        `range_db` of the strongest of its neighborhood.
        """
        if len(found) == 0:
            return known
        samples, reach = self.sounds.shape[1], 10 ** (-range_db / 10)
        explained = _explained(own_gram(poles_of(found, self.sample_rate), samples), measured[0])
        energy, ratio = explained.sum(1), (explained / measured[1].T).mean(1) / 2
        # Few lie high enough for the first, coarse rounds; with all of them each would take as long as the last.
        kept = (ratio > self.significance) & (energy >= energy.amax() * reach)
        both = known.join(found.take(kept))
        order = torch.argsort(both.frequency)
        products, noise = (
            torch.cat([of_known, of_found[..., kept]], dim=-1)[..., order]
            for of_known, of_found in zip(self.measure(known), measured, strict=True)
        )
        both, given = both.take(order), order < len(known)
        energy = torch.zeros(len(both), dtype=torch.float64)
        for first in range(0, max(1, len(both) - _SHARED), _CHUNK - _SHARED):
            rows = torch.arange(first, min(len(both), first + _CHUNK))
            inner = gram(poles_of(both.take(rows), self.sample_rate), samples, power=0)
            part = products[..., rows], noise[:, rows], given[rows]
            gained = choose(inner, *part, significance=self.significance, reach=reach)
            energy[rows] = torch.maximum(energy[rows], gained)
        energy[given] = torch.inf
        most = min(self.count + len(known), int((energy > 0).sum()))
        return both.take(torch.argsort(energy, descending=True)[:most].sort().values)

    def prune(self, bank: ModalBank, *, range_db: float) -> ModalBank:
        """Return `bank` without the modes whose absence the others make up for, the `count` most needed at most.

        A mode goes when leaving it out loses nothing significant, when that loss lies `range_db` below the greatest, or
        when the others nearly span it, so that its gain would be large only to be cancelled by theirs; of neighbors
        that could stand in for each other the least needed goes first.
        """
        system = NormalEquations.of(self.sounds, poles_of(bank, self.sample_rate))
        noise, total = noise_at(self.noise, bank, self.sample_rate), torch.zeros(0, dtype=torch.float64)
        while len(bank) > 0:
            lost, apart = system.lost_without()
            ratio = (lost / noise).mean(0) / 2
            total = lost.sum(0)
            weak = (ratio < self.significance) | (total < total.max() * 10 ** (-range_db / 10)) | (apart < _MIN_APART)
            if not weak.any():
                break
            width = torch.maximum(bank.damping[:, None], bank.damping[None, :]) * (3 / (2 * math.pi))
            near = (bank.frequency[:, None] - bank.frequency[None, :]).abs() <= width
            # By index, not by value: of two that are equal only one may go.
            least = torch.where(near & weak[None, :], total[None, :], torch.inf).argmin(1)
            kept = torch.nonzero(~weak | (least != torch.arange(len(bank)))).flatten()
            bank, noise = bank.take(kept), noise[:, kept]
            system, total = system.take(kept), total[kept]
        return bank.take(torch.argsort(total, descending=True)[: self.count].sort().values)


def _explained(
    own: Float64[Tensor, "modes 2 2"], products: Float64[Tensor, "contacts 2 modes"]
) -> Float64[Tensor, "modes contacts"]:
    """Return the energy of each sound that each mode alone explains: p' G^-1 p, of two by two matrices G."""
    sine, cosine = products.permute(2, 1, 0).unbind(1)
    crossed = (own[:, 0, 1] + own[:, 1, 0])[:, None] * sine * cosine
    energy = own[:, 1, 1, None] * sine.square() - crossed + own[:, 0, 0, None] * cosine.square()
    return energy / (own[:, 0, 0] * own[:, 1, 1] - own[:, 0, 1] * own[:, 1, 0])[:, None]


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
