"""The phase of a mode: how its damped sine starts, the same wherever the object is struck.

A hammer's push takes time and sound takes time to the microphone, so that no recording starts as pure sines. Where the
object is struck decides a mode's strength and sign; what turns its phase stays: the pulse, the way to the microphone.
"""

import torch
from jaxtyping import Float, Float64
from torch import Tensor


def common_phase(
    gains: Float[Tensor, "contacts modes"], quadrature: Float[Tensor, "contacts modes"]
) -> Float64[Tensor, " modes"]:
    """Return the phase of each mode, radians in (-pi/2, pi/2], that all contacts agree on best.

    Mode k starts at contact i as gains sin + quadrature cos = Im(a_ik exp(i w t)) with a = gains + i quadrature. The
    phase p that leaves most energy in the real part of a exp(-i p), over all contacts and whatever their signs, is half
    the argument of the sum over contacts of a^2.
    """
    amplitudes = torch.complex(gains.double(), quadrature.double())
    return torch.angle(amplitudes.square().sum(dim=0)) / 2


def turned_like(
    parts: Float64[Tensor, "contacts modes 2"], others: Float64[Tensor, "contacts modes 2"]
) -> Float64[Tensor, "contacts modes 2"]:
    """Return gains in two parts with each mode turned, by one phase for all contacts, to where they suit others best.

    A mode whose frequency has moved a little has turned for a sound as a whole, and has the same gains.
    """
    one, other = torch.view_as_complex(parts.contiguous()), torch.view_as_complex(others.contiguous())
    turn = (one.conj() * other).sum(0)
    return torch.view_as_real(one * torch.polar(torch.ones_like(turn.real), turn.angle()))
