"""Finite elements: errors against beam and plate theory, and what the modes of a bowl cost at several sizes."""

import json
import math
import os
import subprocess
import sys
import time
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize
import torch

from avmsf.fem.elastic_modes import elastic_modes
from avmsf.fem.elements import SecondOrder
from avmsf.fem.material import CERAMIC, STEEL, Material
from avmsf.fem.solid import Solid
from benchmarks.report import Options, Report, Table, log
from benchmarks.step import peak_gigabytes
from tests.oracles.block import block

_LEISSA = np.array([13.489, 19.789, 24.432, 35.024, 35.024, 61.526])
"""Angular frequencies of a free square plate times side^2 sqrt(mass a square meter / rigidity), Poisson's ratio .3."""


def measure_fem(options: Options) -> Report:
    """Return the errors, and the time and memory of each size of bowl, taken in a process of its own."""
    rings = (4, 6) if options.quick_look else (11, 16, 23, 33, 47)
    fine = 8 if options.quick_look else 60
    rows: list[list[str | float]] = []
    reference = np.array(_in_a_process(fine)["frequency"])
    for sides in rings:
        taken = _in_a_process(sides)
        error = float(np.abs(np.array(taken["frequency"]) / reference - 1)[:20].max())
        rows.append([f"{sides} x {sides}", taken["dofs"], taken["seconds"], taken["megabytes"], error])
        log(f"fem: {taken['dofs']} degrees of freedom in {taken['seconds']:.1f} s")
    chosen = next((row for row in rows if float(row[1]) >= 40_000), rows[-1])
    figures = {
        "fem.beam_error": beam_error(),
        "fem.plate_error": plate_error(),
        "fem.seconds": float(chosen[2]),
        "fem.megabytes": float(chosen[3]),
        "fem.dofs": float(chosen[1]),
    }
    conventions = (
        "fem.beam_error: largest relative error of the three lowest bending frequencies of a free steel bar, 400 x 12 "
        "x 8 mm, against Timoshenko's beam; fem.plate_error: of the six lowest of a free square plate, 200 x 200 x 2 "
        "mm, against Leissa's table.",
        "fem.seconds: 64 modes of a ceramic bowl, a square of 120 mm and 4 mm thick bent onto a sphere of 100 mm, from "
        f"tetrahedra to modes, of the first size with 40,000 degrees of freedom, in a process of its own on "
        f"{os.cpu_count()} processors; megabytes: its peak memory above what it had before.",
        f"error: largest of the 20 lowest frequencies against {fine} x {fine} boxes.",
    )
    columns = ("boxes in the wall", "degrees of freedom", "seconds", "megabytes", "error")
    return Report(conventions, (Table("64 modes of a bowl", columns, rows),), figures)


def beam_error() -> float:
    """Return the largest relative error of the lowest three bending frequencies of a free bar."""
    length, width, height = 0.4, 0.012, 0.008
    found = elastic_modes(block((length, width, height), (24, 1, 1)), STEEL, count=8).frequency
    expected = sorted(timoshenko(length, side, STEEL, number) for side in (width, height) for number in range(3))
    return max(float((found / each - 1).abs().min()) for each in expected[:3])


def plate_error() -> float:
    """Return the largest relative error of the lowest six frequencies of a free square plate."""
    side, thickness = 0.2, 0.002
    steel = Material("steel", 7850.0, 2e11, 0.3, 0.0, 0.0)
    found = elastic_modes(block((side, side, thickness), (24, 24, 1)), steel, count=6).frequency
    rigidity = steel.young * thickness**3 / (12 * (1 - steel.poisson**2))
    factors = 2 * math.pi * found.numpy() * side**2 * math.sqrt(steel.density * thickness / rigidity)
    return float(np.abs(factors / _LEISSA - 1).max())


def timoshenko(length: float, side: float, material: Material, number: int) -> float:
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


def _in_a_process(sides: int) -> dict[str, Any]:
    """Return what `_measure_bowl` prints in a fresh process, whose memory is its own."""
    command = [sys.executable, "-m", "benchmarks.fem", str(sides)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(ended.stdout.splitlines()[-1])


def _measure_bowl(sides: int) -> dict[str, Any]:
    """Return frequencies, degrees of freedom, seconds, and megabytes above those that the process began with."""
    solid = bowl(sides)
    # Warm up what is loaded at first use.
    elastic_modes(bowl(3), CERAMIC, count=4)
    before = peak_gigabytes()
    begun = time.perf_counter()
    modes = elastic_modes(solid, CERAMIC, count=64)
    return {
        "seconds": time.perf_counter() - begun,
        "megabytes": 1e3 * (peak_gigabytes() - before),
        "dofs": 3 * len(SecondOrder.of(solid).nodes),
        "frequency": modes.frequency.tolist(),
    }


if __name__ == "__main__":
    print(json.dumps(_measure_bowl(int(sys.argv[1]))))
