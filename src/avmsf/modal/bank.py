"""The modes of an object, and what an extraction finds in a set of recordings."""

from dataclasses import dataclass

from jaxtyping import Float, Float64
from torch import Tensor

from avmsf.modal.residual import Residual


@dataclass(frozen=True, eq=False)
class ModalBank:
    """Damped sines that all contacts share (paper, eq. 3): mode i sounds as exp(-d_i t) sin(2 pi f_i t)."""

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz, ascending as extracted and fitted; edits keep the order of the modes."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s, positive."""

    def __len__(self) -> int:
        return self.frequency.shape[0]


@dataclass(frozen=True, eq=False)
class Extraction:
    """Modes shared by all recordings, their gains in each, and the noise beneath them."""

    bank: ModalBank
    gains: Float[Tensor, "contacts modes"]
    """Signed amplitude of exp(-d t) sin(2 pi f t) in each recording, in the recordings' own unit."""
    residual: Residual
    quadrature: Float[Tensor, "contacts modes"]
    """Amplitude of exp(-d t) cos(2 pi f t) beside it: what of the mode does not start as a sine at the onset."""
