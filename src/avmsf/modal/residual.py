"""What is heard beside the modes: noise of one colour, the same at every contact (paper, section 3.4)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Residual:
    """Stationary noise by frequency band."""

    magnitude: Float[Tensor, " bins"]
    """Standard deviation of the white noise that each band is cut from (bins evenly spaced from 0 Hz to half the
    sample rate), so that all ones is white noise of unit variance. Not negative."""
