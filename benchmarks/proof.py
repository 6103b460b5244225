"""Finite elements: errors against beam and plate theory, and what the modes of a bowl cost at several sizes."""

import math
from collections.abc import Iterator

import numpy as np
import scipy.linalg
import scipy.optimize
import torch

from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import CERAMIC, STEEL, Material
from avmsf.fem.solid import Solid
from benchmarks.processes import apart, peak_gigabytes, timed
from benchmarks.records import Measurement, Record, Settings, records
from tests.oracles.block import block

_LEISSA = np.array([13.489, 19.789, 24.432, 35.024, 35.024, 61.526])
"""Angular frequencies of a free square plate times side^2 sqrt(mass a square meter / rigidity), Poisson's ratio .3."""


def _fem(settings: Settings) -> Iterator[Record]:
    """Errors of frequencies, and what 64 modes of a ceramic bowl take, from tetrahedra to modes.

    beam_error: largest relative error of the three lowest bending frequencies of a free steel bar, 400 x 12 x 8 mm,
    against Timoshenko's beam; plate_error: of the six lowest of a free square plate, 200 x 200 x 2 mm, against Leissa's
    table. The bowl is a square of 120 mm and 4 mm thick bent onto a sphere of 100 mm, so many boxes along each side,
    each in a process of its own; megabytes: its peak memory above what it had before; error: largest of the 20 lowest
    frequencies against 60 x 60 boxes.
    """
    yield from records({"beam_error": _beam_error(), "plate_error": _plate_error()})
    reference = np.array(apart(bowl_cost, 8 if settings.quick else 60)[1])
    for sides in (4, 6) if settings.quick else (11, 16, 23, 33, 47):
        values, frequency = apart(bowl_cost, sides)
        error = float(np.abs(np.array(frequency) / reference - 1)[:20].max())
        yield from records({**values, "error": error}, object=f"{sides} x {sides}")


def _beam_error() -> float:
    """Return the largest relative error of the lowest three bending frequencies of a free bar."""
    length, width, height = 0.4, 0.012, 0.008
    found = elastic_modes(block((length, width, height), (24, 1, 1)), STEEL, count=8).frequency
    expected = sorted(_timoshenko(length, side, STEEL, number) for side in (width, height) for number in range(3))
    return max(float((found / each - 1).abs().min()) for each in expected[:3])


def _plate_error() -> float:
    """Return the largest relative error of the lowest six frequencies of a free square plate."""
    side, thickness = 0.2, 0.002
    steel = Material("steel", 7850.0, 2e11, 0.3, 0.0, 0.0)
    found = elastic_modes(block((side, side, thickness), (24, 24, 1)), steel, count=6).frequency
    rigidity = steel.young * thickness**3 / (12 * (1 - steel.poisson**2))
    factors = 2 * math.pi * found.numpy() * side**2 * math.sqrt(steel.density * thickness / rigidity)
    return float(np.abs(factors / _LEISSA - 1).max())


def _timoshenko(length: float, side: float, material: Material, number: int) -> float:
    """Return a free bar's bending frequency in hertz, `side` meters in the plane of bending, the lowest number 0.

    Exact for Timoshenko's beam with Cowper's shear coefficient: deflection, slope, moment and shear force are carried
    from end to end by a matrix exponential, which at a natural frequency takes both forces from zero to zero.
    """
    # For a bar one meter wide, which cancels.
    inertia = side**3 / 12
    shear = 10 * (1 + material.poisson) / (12 + 11 * material.poisson)
    rigidity = shear * material.young / (2 * (1 + material.poisson)) * side
    wave = (4.730040745, 7.853204624, 10.995607838)[number]
    euler = wave**2 / length**2 * math.sqrt(material.young * inertia / (material.density * side))

    def forces(omega: float) -> float:
        carried = np.zeros((4, 4))
        carried[0, 1], carried[0, 3] = 1.0, 1.0 / rigidity
        carried[1, 2] = 1.0 / (material.young * inertia)
        carried[2, 3], carried[2, 1] = -1.0, -material.density * inertia * omega**2
        carried[3, 0] = -material.density * side * omega**2
        return float(np.linalg.det(scipy.linalg.expm(carried * length)[2:, :2]))

    return float(scipy.optimize.brentq(forces, 0.85 * euler, 1.001 * euler)) / (2 * math.pi)


def bowl(sides: int) -> Solid:
    """Return a square of 120 mm, 4 mm thick, bent onto a sphere of 100 mm, `sides` boxes along each side."""
    flat = block((0.12, 0.12, 0.004), (sides, sides, 1))
    directions = flat.points - torch.tensor([0.06, 0.06, 0.0], dtype=torch.float64)
    directions[:, 2] = 0.1
    radii = 0.1 + flat.points[:, 2:]
    return Solid.build(radii * directions / directions.norm(dim=1, keepdim=True), flat.cells)


def bowl_cost(sides: int) -> tuple[dict[str, float], list[float]]:
    """Return degrees of freedom, seconds, megabytes above those that the process began with, and frequencies."""
    solid = bowl(sides)
    # Warm up what is loaded at first use.
    elastic_modes(bowl(3), CERAMIC, count=4)
    before = peak_gigabytes()
    modes, seconds = timed(lambda: elastic_modes(solid, CERAMIC, count=64))
    values = {"dofs": 3 * len(SecondOrder.of(solid).nodes), "seconds": seconds}
    return values | {"megabytes": 1e3 * (peak_gigabytes() - before)}, modes.frequency.tolist()


PARTS: dict[str, Measurement] = {"fem": _fem}
