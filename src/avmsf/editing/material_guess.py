"""What a field may be made of, by how fast its modes die away."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.editing.material import rayleigh_damping
from avmsf.fem.material import MATERIALS, Material
from avmsf.modal.modes import ModalBank

FITS = 1.5
"""By which factor, up or down, the middle one of a field's dampings may miss a law that is said to fit."""


@dataclass(frozen=True)
class Guess:
    """A material, and how well its damping fits."""

    material: Material
    off: float
    """Factor, up or down, by which modes of half the weight miss the law, or by more; 1 is a perfect fit."""

    @property
    def fits(self) -> bool:
        """Whether it is near enough to be taken for the field's material."""
        return self.off <= FITS


def guess_materials(
    bank: ModalBank,
    weight: Float64[Tensor, " modes"] | None = None,
    *,
    materials: Iterable[Material] = tuple(MATERIALS.values()),
) -> tuple[Guess, ...]:
    """Return a guess for each material that damps at all, the best one first.

    By each mode's damping over that of the material's Rayleigh law at its frequency, of which the middle one counts, by
    weight (equal without one): a few modes that lose their energy elsewhere are no matter. Dampings alone tell some
    materials badly apart, as ceramic and iron, so that the second guess matters too.
    """
    omega = torch.hypot(2.0 * math.pi * bank.frequency, bank.damping)
    guesses = []
    for material in materials:
        if material.alpha > 0 or material.beta > 0:
            misses, order = (bank.damping / rayleigh_damping(omega, material)).log().abs().sort()
            below = (torch.ones_like(misses) if weight is None else weight[order]).cumsum(0)
            middle = int(torch.searchsorted(below, 0.5 * below[-1]))
            guesses.append(Guess(material, math.exp(float(misses[middle]))))
    return tuple(sorted(guesses, key=lambda guess: guess.off))
