"""A hammer's impact: how long its tip stays on the body, how hard it presses, and what that leaves of each mode.

Two pulses of duration tau and impulse 1 newton second, both of which begin at time zero:

    half-sine   pi / (2 tau) sin(pi t / tau), a mass on a linear spring: a tip with a flat face of radius a, for which
                the spring has 2 a E* and tau = pi sqrt(m / (2 a E*));
    hertz       N sin(pi t / tau)^(3/2), within 3 % of Hertz's pulse of a round tip of radius a, for which
                tau = 2.868 (m^2 / (a E*^2 v))^(1/5).

1/E* = (1 - nu_1^2) / E_1 + (1 - nu_2^2) / E_2 joins both materials, m = 1 / (1 / m_hammer + 1 / m_body) both masses as
if the body were rigid and free, v is the speed, and the tip bounces off as fast as it came: the impulse is 2 m v. A
vibration that the pulse has left behind is the one of an impulse at time zero times the pulse's Laplace transform at
the vibration's pole, in size and in phase.
"""

import math

import numpy as np
import torch
from jaxtyping import Complex128, Float64
from scipy.special import loggamma
from torch import Tensor

from avmsf.errors import SimulationError
from avmsf.fem.material import Material
from avmsf.modal.config import MAX_CONTACT_SECONDS
from avmsf.simulate.recipe import Hammer

_HERTZ_SCALE = 2.868
_HERTZ_AREA = math.sqrt(math.pi) * math.gamma(1.25) / math.gamma(1.75)
"""Integral of sin(x)^(3/2) from 0 to pi."""


def moving_mass(hammer: Hammer, mass: float) -> float:
    """Return what hammer and body weigh against each other, kilograms."""
    return 1.0 / (1.0 / hammer.mass + 1.0 / mass)


def contact_times(
    hammer: Hammer, material: Material, *, mass: float, speeds: Float64[Tensor, " contacts"]
) -> Float64[Tensor, " contacts"]:
    """Return how long the tip stays on a body of this material and mass, kg, for impacts of these speeds, m/s; seconds.

    A round tip stays for a time that goes with the speed to the power -1/5, a flat one equally long at all speeds.
    Raises SimulationError where that is longer than `MAX_CONTACT_SECONDS`.
    """
    flat = hammer.pulse == "half-sine"
    joint = 1.0 / ((1.0 - hammer.poisson**2) / hammer.young + (1.0 - material.poisson**2) / material.young)
    moving = moving_mass(hammer, mass)
    if hammer.contact_time > 0.0:
        times = hammer.contact_time * (speeds / hammer.speed) ** (0.0 if flat else -0.2)
    elif flat:
        times = torch.full_like(speeds, math.pi * math.sqrt(moving / (2.0 * hammer.radius * joint)))
    else:
        times = _HERTZ_SCALE * (moving**2 / (hammer.radius * joint**2 * speeds)) ** 0.2
    longest = float(times.max())
    if longest > MAX_CONTACT_SECONDS:
        wanted, got = f"a contact time up to {MAX_CONTACT_SECONDS:g} s", f"{longest:.2g} s"
        advice = "use a lighter hammer, a stiffer tip, or a higher speed"
        raise SimulationError.expected(wanted, longest, got=got, name="hammer", advice=advice)
    return times


def peak_forces(
    hammer: Hammer, *, mass: float, speeds: Float64[Tensor, " contacts"], times: Float64[Tensor, " contacts"]
) -> Float64[Tensor, " contacts"]:
    """Return the greatest force of each impact on a body of this mass, newtons."""
    impulses = 2.0 * moving_mass(hammer, mass) * speeds
    area = 2.0 if hammer.pulse == "half-sine" else _HERTZ_AREA
    return impulses * math.pi / (area * times)


def pulse_spectrum(
    hammer: Hammer, poles: Complex128[Tensor, " modes"], times: Float64[Tensor, " contacts"]
) -> Complex128[Tensor, "contacts modes"]:
    """Return the Laplace transform of each impact's pulse, scaled to a peak of one newton, at the poles; seconds.

    The integral of sin(x)^(v - 1) exp(i b x) from 0 to pi is, with i b = -s tau / pi,
    pi exp(i b pi / 2) Gamma(v + 1) / (2^(v - 1) v Gamma((v + b + 1) / 2) Gamma((v - b + 1) / 2)).
    """
    v, area = (2.0, 2.0) if hammer.pulse == "half-sine" else (2.5, _HERTZ_AREA)
    b = 1j * (times[:, None] * poles[None, :]).numpy() / math.pi
    logarithm = loggamma((v + 1.0 + b) / 2.0) + loggamma((v + 1.0 - b) / 2.0)
    scale = math.pi * math.gamma(v + 1.0) / (2.0 ** (v - 1.0) * v * area)
    return times[:, None] * (area / math.pi) * torch.from_numpy(scale * np.exp(0.5j * math.pi * b - logarithm))
