"""What an extraction returns: the modes of an object and how strongly each recording excites them."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from avmsf.modal.bank import ModalBank
from avmsf.modal.residual import Residual


@dataclass(frozen=True, eq=False)
class Extraction:
    """Modes shared by all recordings, their gains in each, and the noise beneath them."""

    bank: ModalBank
    gains: Float[Tensor, "contacts modes"]
    """Signed amplitude of exp(-d t) sin(2 pi f t) in each recording, in the recordings' own unit."""
    residual: Residual
    quadrature: Float[Tensor, "contacts modes"]
    """Amplitude of exp(-d t) cos(2 pi f t) beside it: what of the mode does not start as a sine at the onset."""
