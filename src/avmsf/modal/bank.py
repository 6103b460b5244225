"""The modes of an object: frequencies and dampings that all contacts share."""

from dataclasses import dataclass

from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class ModalBank:
    """Damped sines that all contacts share (paper, eq. 3): mode i sounds as exp(-d_i t) sin(2 pi f_i t)."""

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz, ascending as extracted and fitted; edits keep the order of the modes."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s, positive."""

    def __repr__(self) -> str:
        if not len(self):
            return "ModalBank(0 modes)"
        ranges = [f"{float(each.min()):.5g} to {float(each.max()):.5g}" for each in (self.frequency, self.damping)]
        return f"ModalBank({len(self)} modes, {ranges[0]} Hz, damping {ranges[1]} 1/s)"

    def __len__(self) -> int:
        return self.frequency.shape[0]
