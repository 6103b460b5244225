"""Which candidates are modes: forward selection by explained energy, then removal of what the rest explains as well."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64, Int64
from scipy.special import gammainccinv
from torch import Tensor

from avmsf.modal.extraction.forward import choose
from avmsf.modal.extraction.least_squares import NormalEquations
from avmsf.modal.inner_products import gram, own_gram, poles_of, project
from avmsf.modal.modes import ModalBank

_CHUNK, _SHARED = 120, 30
"""Candidates judged together, in order of frequency, and how many of them the next chunk judges again."""
_APART = 0.01
"""Least part of a mode that the others must not span: with less, gains of large and opposite modes would cancel."""
_SAME = 0.03
"""Candidates closer than this part of their width, with dampings as close, are one."""
_NEIGHBORS = 30
"""Kept candidates just below a new one among which it may find its double."""


def merge(
    frequency: Float64[Tensor, " candidates"], damping: Float64[Tensor, " candidates"], *, duration: float
) -> ModalBank:
    """Return the candidates without those that repeat another: nearer than they could be told apart.

    A mode's width is its damping over 2 pi, at least what `duration` seconds resolve.
    """
    order = torch.argsort(frequency)
    ascending, rates = frequency[order].tolist(), damping[order].tolist()

    def repeats(row: int, other: int) -> bool:
        narrow = max(min(rates[row], rates[other]), 1 / duration) / (2 * math.pi)
        return ascending[row] - ascending[other] < _SAME * narrow and abs(math.log(rates[row] / rates[other])) < _SAME

    kept: list[int] = []
    for row in range(len(ascending)):
        if not any(repeats(row, other) for other in kept[-_NEIGHBORS:]):
            kept.append(row)
    index = order[torch.tensor(kept, dtype=torch.long)]
    return ModalBank(frequency[index], damping[index])


def chance_ratio(contacts: int, *, trials: int) -> float:
    """Return how many times its mean the energy that a mode explains of white noise is at most, of `trials` modes.

    A mode has two amplitudes in each of the recordings, so the energy is chi-squared with twice as many degrees of
    freedom; exceeded once in ten searches by chance.
    """
    return float(gammainccinv(contacts, 0.1 / trials)) / contacts


@dataclass(frozen=True, eq=False)
class Candidates:
    """What may be modes, with what judging them needs; by frequency."""

    bank: ModalBank
    products: Float64[Tensor, "contacts two candidates"]
    """Inner products of the sounds with the sines and the cosines."""
    noise: Float64[Tensor, "contacts candidates"]
    """Power of the noise where each of them lies."""

    @classmethod
    def of(
        cls,
        sounds: Float[Tensor, "contacts samples"],
        bank: ModalBank,
        noise: Float64[Tensor, "contacts candidates"],
        *,
        sample_rate: float,
    ) -> "Candidates":
        """Return the modes of `bank` as candidates in `sounds`."""
        products, _ = project(sounds, poles_of(bank, sample_rate))
        return cls(bank, products.reshape(len(sounds), 2, len(bank)), noise)

    def take(self, rows: Int64[Tensor, " kept"]) -> "Candidates":
        """Return the given candidates alone."""
        bank = self.bank.take(rows)
        return Candidates(bank, self.products[:, :, rows], self.noise[:, rows])

    def join(self, other: "Candidates") -> "Candidates":
        """Return these and then the others."""
        return Candidates(
            ModalBank(
                torch.cat([self.bank.frequency, other.bank.frequency]),
                torch.cat([self.bank.damping, other.bank.damping]),
            ),
            torch.cat([self.products, other.products], dim=2),
            torch.cat([self.noise, other.noise], dim=1),
        )

    def score(self, *, samples: int, sample_rate: float) -> tuple[Float64[Tensor, " candidates"], ...]:
        """Return the energy of all sounds that each explains on its own, and how many times what it would of noise."""
        own = own_gram(poles_of(self.bank, sample_rate), samples)
        energy = _explained(own, self.products.permute(2, 1, 0))
        return energy.sum(1), (energy / self.noise.T).mean(1) / 2


def select(
    known: Candidates,
    found: Candidates,
    *,
    samples: int,
    sample_rate: float,
    significance: float,
    range_db: float,
    count: int,
) -> ModalBank:
    """Return `known` and up to `count` of `found`: those that explain most of what is left beside each other.

    A candidate counts only when it explains `significance` times the energy that it would explain of noise, mean over
    the sounds, and within `range_db` of the strongest of its neighborhood. `samples` is the sounds' length.
    """
    if len(found.bank) == 0:
        return known.bank
    energy, ratio = found.score(samples=samples, sample_rate=sample_rate)
    # Few lie high enough for the first, coarse rounds; with all of them each would take as long as the last.
    able = (ratio > significance) & (energy >= energy.amax() * 10 ** (-range_db / 10))
    both = known.join(found.take(torch.nonzero(able).flatten()))
    order = torch.argsort(both.bank.frequency)
    both, given = both.take(order), order < len(known.bank)
    energy = torch.zeros(len(both.bank), dtype=torch.float64)
    first = 0
    while True:
        rows = torch.arange(first, min(len(both.bank), first + _CHUNK))
        chosen = both.take(rows)
        inner = gram(poles_of(chosen.bank, sample_rate), samples, power=0)
        gained = choose(
            inner, chosen.products, chosen.noise, given[rows], significance=significance, reach=10 ** (-range_db / 10)
        )
        energy[rows] = torch.maximum(energy[rows], gained)
        if first + _CHUNK >= len(both.bank):
            break
        first += _CHUNK - _SHARED
    energy[given] = torch.inf
    kept = torch.argsort(energy, descending=True)[: min(count + len(known.bank), int((energy > 0).sum()))].sort().values
    return both.take(kept).bank


def prune(
    sounds: Float[Tensor, "contacts samples"],
    bank: ModalBank,
    noise: Float64[Tensor, "contacts modes"],
    *,
    sample_rate: float,
    significance: float,
    range_db: float,
    count: int,
) -> ModalBank:
    """Return `bank` without the modes whose absence the others make up for, the `count` most needed at most.

    A mode goes when leaving it out loses less than `significance` times what it would explain of noise, when that loss
    lies `range_db` below the greatest, or when the others nearly span it, so that its gain would be large only to be
    cancelled by theirs; of neighbors that could stand in for each other the least needed goes first.
    """
    system = NormalEquations.of(sounds, poles_of(bank, sample_rate))
    total = torch.zeros(0, dtype=torch.float64)
    while len(bank) > 0:
        lost, apart = system.lost_without()
        ratio = (lost / noise).mean(0) / 2
        total = lost.sum(0)
        weak = (ratio < significance) | (total < total.max() * 10 ** (-range_db / 10)) | (apart < _APART)
        if not weak.any():
            break
        width = torch.maximum(bank.damping[:, None], bank.damping[None, :]) * (3 / (2 * math.pi))
        near = (bank.frequency[:, None] - bank.frequency[None, :]).abs() <= width
        # By index, not by value: of two that are equal only one may go.
        least = torch.where(near & weak[None, :], total[None, :], torch.inf).argmin(1)
        kept = torch.nonzero(~weak | (least != torch.arange(len(bank)))).flatten()
        bank, noise = bank.take(kept), noise[:, kept]
        system, total = system.take(kept), total[kept]
    strongest = torch.argsort(total, descending=True)[:count].sort().values
    return bank.take(strongest)


def _explained(
    own: Float64[Tensor, "modes 2 2"], products: Float64[Tensor, "modes 2 contacts"]
) -> Float64[Tensor, "modes contacts"]:
    """Return the energy of each sound that each mode alone explains: p' G^-1 p, of two by two matrices G."""
    sine, cosine = products.unbind(1)
    crossed = (own[:, 0, 1] + own[:, 1, 0])[:, None] * sine * cosine
    energy = own[:, 1, 1, None] * sine.square() - crossed + own[:, 0, 0, None] * cosine.square()
    return energy / (own[:, 0, 0] * own[:, 1, 1] - own[:, 0, 1] * own[:, 1, 0])[:, None]
