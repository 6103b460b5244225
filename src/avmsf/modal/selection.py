"""Which candidates are modes: forward selection by explained energy, then removal of what the rest explains as well."""

import math

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from avmsf.modal.bank import ModalBank
from avmsf.modal.leastsquares import NormalEquations, gram, poles_of, project

_CHUNK, _SHARED = 120, 30
"""Candidates judged together, in order of frequency, and how many of them the next chunk judges again."""
_DISTINCT = 1e-6
"""Part of a candidate's (sine, cosine) area that the chosen ones must leave for it to count as another mode."""
_SAME = 0.03
"""Candidates closer than this part of their width, with dampings as close, are one."""
_NEIGHBOURS = 30
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
        if not any(repeats(row, other) for other in kept[-_NEIGHBOURS:]):
            kept.append(row)
    index = order[torch.tensor(kept, dtype=torch.long)]
    return ModalBank(frequency[index], damping[index])


def select(
    sounds: Float[Tensor, "contacts samples"],
    known: ModalBank,
    found: ModalBank,
    noise: Float64[Tensor, "contacts candidates"],
    *,
    sample_rate: float,
    significance: float,
    range_db: float,
    count: int,
) -> ModalBank:
    """Return `known` and up to `count` of `found`: those that explain most of what is left beside each other.

    `noise` is the noise's power where each of `found` lies: a candidate counts only when it explains `significance`
    times what it would explain of noise, and within `range_db` of the strongest of its neighbourhood.
    """
    both = join(known, found)
    order = torch.argsort(torch.cat([known.frequency, found.frequency]))
    given = order < len(known)
    floor = torch.cat([torch.ones(len(sounds), len(known), dtype=torch.float64), noise], dim=1)[:, order]
    energy = torch.zeros(len(both), dtype=torch.float64)
    first = 0
    while True:
        rows = torch.arange(first, min(len(both), first + _CHUNK))
        part = ModalBank(both.frequency[rows], both.damping[rows])
        gained = _forward(sounds, part, given[rows], floor[:, rows], sample_rate, significance, range_db)
        energy[rows] = torch.maximum(energy[rows], gained)
        if first + _CHUNK >= len(both):
            break
        first += _CHUNK - _SHARED
    energy[given] = torch.inf
    kept = torch.argsort(energy, descending=True)[: min(count + len(known), int((energy > 0).sum()))].sort().values
    return ModalBank(both.frequency[kept], both.damping[kept])


def join(one: ModalBank, other: ModalBank) -> ModalBank:
    """Return the modes of both banks, by frequency."""
    frequency = torch.cat([one.frequency, other.frequency])
    order = torch.argsort(frequency)
    return ModalBank(frequency[order], torch.cat([one.damping, other.damping])[order])


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

    A mode goes when leaving it out loses less than `significance` times what it would explain of noise, or lies
    `range_db` below the mode that is missed most; of neighbours that could stand in for each other the least
    needed goes first.
    """
    if len(bank) == 0:
        return bank
    system = NormalEquations.of(sounds, poles_of(bank, sample_rate))
    while True:
        lost = system.lost_without()
        ratio = (lost / noise).sum(0) / (2 * len(sounds))
        total = lost.sum(0)
        weak = (ratio < significance) | (total < total.max() * 10 ** (-range_db / 10))
        if not weak.any():
            break
        width = torch.maximum(bank.damping[:, None], bank.damping[None, :]) * (3 / (2 * math.pi))
        near = (bank.frequency[:, None] - bank.frequency[None, :]).abs() <= width
        least = torch.where(near & weak[None, :], total[None, :], torch.inf).amin(1)
        kept = torch.nonzero(~(weak & (total <= least))).flatten()
        bank, noise = ModalBank(bank.frequency[kept], bank.damping[kept]), noise[:, kept]
        system = system.take(kept)
    strongest = torch.argsort(total, descending=True)[:count].sort().values
    return ModalBank(bank.frequency[strongest], bank.damping[strongest])


def _forward(
    sounds: Float[Tensor, "contacts samples"],
    bank: ModalBank,
    given: Bool[Tensor, " candidates"],
    noise: Float64[Tensor, "contacts candidates"],
    sample_rate: float,
    significance: float,
    range_db: float,
) -> Float64[Tensor, " candidates"]:
    """Return the energy that each candidate explained when it was chosen, zero if never: orthogonal least squares.

    The `given` ones are chosen first, whatever they explain.
    """
    modes = len(bank)
    poles = poles_of(bank, sample_rate)
    products = project(sounds, poles)[0].unflatten(1, (2, modes)).permute(2, 1, 0).contiguous()
    inner = gram(poles, sounds.shape[1], power=0).reshape(2, modes, 2, modes).permute(1, 0, 3, 2).contiguous()
    whole = torch.diagonal(inner, dim1=0, dim2=2).permute(2, 0, 1).clone()
    chosen = torch.zeros(modes, dtype=torch.float64)
    free = torch.ones(modes, dtype=torch.bool)
    for _ in range(modes):
        left = torch.diagonal(inner, dim1=0, dim2=2).permute(2, 0, 1)
        # What the chosen ones span already cannot be judged: only rounding is left of it.
        distinct = free & (torch.linalg.det(left) > _DISTINCT * torch.linalg.det(whole))
        safe = torch.where(distinct[:, None, None], left, torch.eye(2, dtype=torch.float64))
        explained = (products * torch.linalg.solve(safe, products)).sum(1)
        ratio = (explained / noise.T).sum(1) / (2 * len(sounds))
        first = distinct & given
        wanted = first if first.any() else distinct & (ratio > significance)
        score = torch.where(wanted, explained.sum(1), 0.0)
        best = int(score.argmax())
        if not wanted[best] or (not first[best] and score[best] <= chosen.max() * 10 ** (-range_db / 10)):
            break
        chosen[best] = score[best]
        free[best] = False
        column = inner[:, :, best, :].clone()
        weights = torch.linalg.solve(inner[best, :, best, :], column.flatten(0, 1).T)
        products -= (weights.T @ products[best]).reshape(products.shape)
        inner -= (column.flatten(0, 1) @ weights).reshape(inner.shape)
    return chosen
