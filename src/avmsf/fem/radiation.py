"""How loud a vibrating body is where the listener's place is not known: mean square pressures over all directions.

The pressure in one direction is that of `avmsf.fem.radiated_sound`: Kirchhoff's and Helmholtz's integral, with the
pressure on the surface that a plane wave would have. A pulsating sphere of the same area, which is often taken (Fahy
and Gardonio, *Sound and Structural Vibration*, 2007, chapter 3), makes the lowest modes of vessels and pans 8 to 26 dB
too loud: their parts move against each other, and cancel.
"""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from avmsf.fem.damping import Vibration
from avmsf.fem.elastic_modes import ElasticModes
from avmsf.fem.radiated_sound import radiated

DISTANCE = 1.0
"""Meters that pressures are stated for."""
DIRECTIONS = 64
"""Directions that are averaged: levels of modes are .15 to .31 dB from those of 512 on average (mug, bowl, skillet)."""
_FAR = 100.0
"""Distance of the microphones over the body's size. Pressures go with 1/distance from there on."""


def radiated_pressure(
    modes: ElasticModes, vibration: Vibration, *, directions: int = DIRECTIONS
) -> Float64[Tensor, " modes"]:
    """Return the pressure of each damped mode for a push of one newton second on it alone, pascals.

    The root mean square over directions of its amplitude in the far field, stated for a distance of `DISTANCE`.
    """
    middle = 0.5 * (modes.nodes.amax(0) + modes.nodes.amin(0))
    reach = _FAR * float((modes.nodes.amax(0) - modes.nodes.amin(0)).norm())
    power = torch.zeros(len(vibration.poles), dtype=torch.float64)
    for way in _evenly(directions):
        power += radiated(modes, vibration, middle + reach * way).abs().square()
    return reach / DISTANCE * (power / directions).sqrt()


def _evenly(count: int) -> Float64[Tensor, "count 3"]:
    """Return unit vectors on a spherical Fibonacci lattice (Gonzalez, Mathematical Geosciences 42, 2010)."""
    row = torch.arange(count, dtype=torch.float64)
    height = 1.0 - (2.0 * row + 1.0) / count
    turn = row * math.pi * (3.0 - math.sqrt(5.0))
    flat = (1.0 - height.square()).sqrt()
    return torch.stack([flat * torch.cos(turn), flat * torch.sin(turn), height], dim=1)
