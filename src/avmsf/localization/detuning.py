"""What an object's modes explain of a sound by their number and breadth alone: the same modes, put out of tune.

Broad modes fill their band, so that those of one damped object explain most of any sound in it. What tells the object's
own sounds is how much worse they are explained by modes of the same dampings a little higher or lower.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float, Float64
from torch import Tensor

from avmsf.localization.amplitudes import Extractor
from avmsf.modal.inner_products import poles_of, project
from avmsf.modal.modes import ModalBank

DETUNINGS = (0.9, 0.95, 1.05, 1.1)
"""Factors on all frequencies: 5 % is a half-power bandwidth of a mode that turns six times while it falls to 1/e."""


@dataclass(frozen=True, eq=False)
class DetunedModes:
    """A bank's modes at each of `DETUNINGS`, for sounds of one length."""

    poles: tuple[Complex128[Tensor, " _modes"], ...]
    """Of each detuning, apart: their products with a sound are faster one after the other than all at once."""
    inverses: tuple[Float64[Tensor, "_two_modes _two_modes"], ...]
    """As `Extractor.inverse`."""

    @classmethod
    def of(cls, bank: ModalBank, *, sample_rate: float, samples: int, highest: float) -> "DetunedModes":
        """Return it for sounds at `sample_rate` Hz, of the modes that stay below `highest` Hz.

        A detuning that leaves no mode below is left out; those downwards leave all that are below in tune.
        """
        poles, inverses = [], []
        for factor in DETUNINGS:
            kept = torch.nonzero(factor * bank.frequency < highest).flatten()
            if len(kept):
                moved = ModalBank(factor * bank.frequency[kept], bank.damping[kept])
                poles.append(poles_of(moved, sample_rate))
                inverses.append(Extractor.of(moved, sample_rate=sample_rate, samples=samples).inverse)
        return cls(tuple(poles), tuple(inverses))

    def fitted(self, sound: Float[Tensor, " samples"]) -> Float64[Tensor, " detunings"]:
        """Return the energy of a sound that the modes explain at each detuning, noise included."""
        energies = []
        for poles, inverse in zip(self.poles, self.inverses, strict=True):
            products = project(sound[None], poles)[0][0]
            energies.append(products @ inverse @ products)
        return torch.stack(energies)
