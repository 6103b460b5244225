"""Damped vibrations of a body: Rayleigh damping, dampers at its supports, and damping that couples its modes.

In the coordinates q of the undamped modes, whose shapes are mass-normalized, a force f at a place x obeys

    q'' + C q' + Omega^2 q = phi(x) f,   Omega the angular frequencies on a diagonal.

Damping in proportion to mass and stiffness has C = alpha + beta Omega^2, also diagonal: each mode then decays by itself
with d = (alpha + beta omega^2) / 2 at sqrt(omega^2 - d^2). Any other symmetric C mixes them. With y = (Omega q, q') the
system is y' = A y, A = ((0, Omega), (-Omega, -C)), and its eigenvalues s = -d + 2 pi i f and eigenvectors are the
damped modes, exact for every C: shapes become complex, so that places of one mode no longer move in step.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex128, Float64
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.material import Material

MAX_DAMPING_RATIO = 0.05
"""Damping over the critical one beyond which a mode is left out: it loses half its amplitude in two cycles, is no tone,
and continued back to the onset it would be the loudest of all where it is heard late."""


@dataclass(frozen=True, eq=False)
class Vibration:
    """What an impact leaves behind: damped modes by ascending frequency.

    After an impact that gives undamped mode k the momentum p_k, in sqrt(kg) m/s, mode k accelerates as the sum over
    damped modes r of 2 Re accelerations[k, r] (pushes[r] . p) exp(poles[r] t).
    """

    poles: Complex128[Tensor, " modes"]
    """-d + 2 pi i f, 1/s."""
    accelerations: Complex128[Tensor, "shapes modes"]
    """Of each undamped mode in each damped one."""
    pushes: Complex128[Tensor, "modes shapes"]
    """How much of a push on each undamped mode goes into each damped one."""

    @property
    def frequency(self) -> Float64[Tensor, " modes"]:
        """Damped frequencies, Hz."""
        return self.poles.imag / (2.0 * math.pi)

    @property
    def damping(self) -> Float64[Tensor, " modes"]:
        """Amplitude decay rates, 1/s."""
        return -self.poles.real


def rayleigh(frequency: Float64[Tensor, " modes"], material: Material) -> Float64[Tensor, " modes"]:
    """Return alpha + beta omega^2 for undamped frequencies in Hz: twice the amplitude decay rates, 1/s."""
    return material.alpha + material.beta * (2.0 * math.pi * frequency).square()


def damped(
    frequency: Float64[Tensor, " shapes"], damping: Float64[Tensor, "shapes shapes"], *, highest: float
) -> Vibration:
    """Return the damped modes that sound up to `highest` Hz.

    `frequency` holds undamped frequencies, Hz, and `damping` the matrix C, 1/s, symmetric. Modes damped by more than
    `MAX_DAMPING_RATIO` of their critical damping are left out. Raises SimulationError where none is left.
    """
    count = len(frequency)
    omega = 2.0 * math.pi * torch.diag(frequency)
    system = torch.cat([torch.cat([torch.zeros_like(omega), omega], 1), torch.cat([-omega, -damping], 1)])
    poles, vectors = torch.linalg.eig(system)
    # Rows of the inverse, not the vectors again, are what belongs to two modes that share a pole.
    inverse = torch.linalg.inv(vectors)
    ringing = (poles.imag > 0.0) & (-poles.real <= MAX_DAMPING_RATIO * poles.abs())
    audible = torch.nonzero(ringing & (poles.imag <= 2.0 * math.pi * highest)).flatten()
    if len(audible) == 0:
        lowest = float(frequency.min())
        wanted, got = f"damped modes up to {highest:g} Hz", f"none of {count}, the lowest at {lowest:.4g} Hz undamped"
        advice = "make the object larger or thinner, its material softer or less damped, or raise the sample rate"
        raise SimulationError.expected(wanted, lowest, got=got, name="frequency", advice=advice)
    audible = audible[torch.argsort(poles.imag[audible])]
    return Vibration(
        poles[audible], vectors[count:, audible] * poles[audible], inverse[audible, count:].resolve_conj().contiguous()
    )
