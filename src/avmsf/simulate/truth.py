"""What is known of a simulated object and of no recorded one: its modes, and how strongly each blow excited them."""

from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Truth:
    """The modes in a set of simulated recordings, row for row of its `Impacts`.

    Recording i is, but for noise, the sum over modes k of exp(-d_k t) (gains[i, k] sin(2 pi f_k t) + quadrature[i, k]
    cos(2 pi f_k t)), t from the onset.
    """

    frequency: Float64[Tensor, " modes"]
    """Damped frequencies, Hz, ascending."""
    damping: Float64[Tensor, " modes"]
    """Amplitude decay rates, 1/s."""
    gains: Float64[Tensor, "contacts modes"]
    """Signed amplitudes in phase, in the unit of the recordings."""
    quadrature: Float64[Tensor, "contacts modes"]
    """Amplitudes in quadrature."""
    names: tuple[str, ...]
    """The recordings' names, in the order of the rows."""
    recipe: dict[str, Any] = field(default_factory=dict)
    """All settings that the object was made with, as plain values."""
