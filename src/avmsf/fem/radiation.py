"""How loud a vibrating body is without a listener's place: the pressure of each mode, averaged over directions.

A body of surface area S whose mode vibrates with the normal velocity v_n radiates the power

    W = rho c sigma(k a) integral of <v_n^2> over S,   sigma(k a) = (k a)^2 / (1 + (k a)^2),   a = sqrt(S / (4 pi)),

with the radiation efficiency sigma of a pulsating sphere of the same area, k the wavenumber in air (Fahy and Gardonio,
*Sound and Structural Vibration*, 2007, sections 3.2 and 3.3). At the distance r the mean square pressure over all
directions is rho c W / (4 pi r^2). The efficiency holds for parts of the surface that move alike. Parts that move
against each other cancel in part at low frequencies, so the lowest modes are quieter than that.
"""

import math

from jaxtyping import Float64
from torch import Tensor

from avmsf.simulate.elastic import ElasticModes
from avmsf.simulate.radiation import AIR_DENSITY, SOUND_SPEED, surface_patches

DISTANCE = 1.0
"""Meters at which pressures are stated."""


def radiated_pressure(modes: ElasticModes) -> Float64[Tensor, " modes"]:
    """Return the pressure amplitude of each mode at `DISTANCE`, root mean square over directions, for unit momentum.

    In pascals per (kg^.5 m/s) of modal momentum: times the component of the mode shape along an impact of one newton
    second (`ElasticModes.gains`) it is the amplitude in pascals.
    """
    _, outward, motion = surface_patches(modes)
    area = outward.norm(dim=1)
    squares = area @ motion.square()
    wave = 2.0 * math.pi * modes.frequency / SOUND_SPEED * math.sqrt(float(area.sum()) / (4.0 * math.pi))
    efficiency = wave.square() / (1.0 + wave.square())
    return AIR_DENSITY * SOUND_SPEED / DISTANCE * (efficiency * squares / (4.0 * math.pi)).sqrt()
