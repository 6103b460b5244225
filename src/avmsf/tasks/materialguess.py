"""What a field may be made of, told by how fast its modes die away."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch

from avmsf.modal.bank import ModalBank
from avmsf.simulate.material import MATERIALS, Material
from avmsf.tasks.material import rayleigh_damping

FITS = 2.0
"""By which factor, up or down, the middle one of a field's dampings may miss a law that is said to fit."""


@dataclass(frozen=True)
class Guess:
    """A material, and how well its damping fits."""

    material: Material
    off: float
    """Factor, up or down, by which half of the modes' dampings miss the law, or by more; 1 is a perfect fit."""

    @property
    def fits(self) -> bool:
        """Whether it is near enough to be taken for the field's material."""
        return self.off <= FITS


def guess_materials(bank: ModalBank, materials: Iterable[Material] = tuple(MATERIALS.values())) -> tuple[Guess, ...]:
    """Return a guess for each material that damps at all, the best one first.

    By each mode's damping over that of the material's Rayleigh law at its frequency, of which the middle one counts: a
    few modes that lose their energy elsewhere are no matter. Dampings alone tell some materials badly apart, as
    ceramic and iron, so that the second guess matters too.
    """
    omega = torch.hypot(2.0 * math.pi * bank.frequency, bank.damping)
    guesses = []
    for material in materials:
        if material.alpha > 0 or material.beta > 0:
            misses = (bank.damping / rayleigh_damping(omega, material)).log().abs()
            guesses.append(Guess(material, math.exp(float(misses.quantile(0.5)))))
    return tuple(sorted(guesses, key=lambda guess: guess.off))
