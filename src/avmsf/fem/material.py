"""What objects are made of: the constants of linear elasticity, and how fast vibrations die in it."""

import math
from dataclasses import dataclass

from avmsf.errors import SimulationError


@dataclass(frozen=True)
class Material:
    """An isotropic linear material with Rayleigh damping."""

    name: str
    density: float
    """Kilograms per cubic meter."""
    young: float
    """Young's modulus, pascals."""
    poisson: float
    """Poisson's ratio, between -1 and .5, both excluded."""
    alpha: float
    """Rayleigh damping in proportion to mass, 1/s."""
    beta: float
    """Rayleigh damping in proportion to stiffness, s."""

    def __post_init__(self) -> None:
        limits = {
            "density": (0 < self.density < math.inf, "more than 0 kg/m3"),
            "young": (0 < self.young < math.inf, "more than 0 Pa"),
            "poisson": (-1 < self.poisson < 0.5, "more than -1 and less than .5; solids have .1 to .45"),
            "alpha": (0 <= self.alpha < math.inf, "0 1/s or more"),
            "beta": (0 <= self.beta < math.inf, "0 s or more"),
        }
        for name, (fits, wanted) in limits.items():
            if not fits:
                raise SimulationError.expected(f"{wanted} in {self.name}", getattr(self, name), name=name)


CERAMIC = Material("ceramic", 2700.0, 7.2e10, 0.19, 6.0, 1e-7)
GLASS = Material("glass", 2600.0, 6.2e10, 0.20, 1.0, 1e-7)
WOOD = Material("wood", 750.0, 1.1e10, 0.25, 60.0, 2e-6)
PLASTIC = Material("plastic", 1070.0, 1.4e9, 0.35, 30.0, 1e-6)
IRON = Material("iron", 8000.0, 2.1e11, 0.28, 10.0, 1e-7)
POLYCARBONATE = Material("polycarbonate", 1190.0, 2.4e9, 0.37, 0.5, 4e-7)
STEEL = Material("steel", 7850.0, 2e11, 0.29, 20.0, 3e-8)
MATERIALS = {material.name: material for material in (CERAMIC, GLASS, WOOD, PLASTIC, IRON, POLYCARBONATE, STEEL)}
"""The table that DiffSound simulates with, by name."""


SOFTEST, *_, STIFFEST = sorted(MATERIALS.values(), key=lambda each: each.young / each.density)
"""Of the table, relative to their density."""
NOMINAL = Material("nominal", 2700.0, 7e10, 0.3, 0.0, 0.0)
"""What bodies are taken to be made of: near aluminium. Frequencies are to be scaled by one common factor, and shapes
depend on Poisson's ratio alone, weakly."""
MAX_FREQUENCY_ERROR = 0.05
"""Relative error of the lowest frequencies beyond which a body is made finer: about that by which frequencies of real
walls differ from those of even ones (imperfections of 3 to 5 % in the simulated objects)."""
DISCREPANCY = 0.2
"""Standard deviation of the log thickness that errors of the shape leave, which the evidence takes for right: the root
mean square log ratio to the truth over 11 simulated walls from photographs (most are .82 to .94, one is 1.4)."""


def factor_range() -> tuple[float, float]:
    """Return the least and the largest factor on the frequencies of a body of `NOMINAL` that can be a material's.

    A body's frequencies go with sqrt(E / rho): those of the table, with what makes frequencies of real bodies differ
    from those of even ones (`MAX_FREQUENCY_ERROR`). Bending frequencies also go with the thickness, which may be off by
    the `DISCREPANCY`, as that of a scan or a measured wall may.
    """
    uncertain = (1.0 + MAX_FREQUENCY_ERROR) * (1.0 + DISCREPANCY)
    low, high = (math.sqrt(each.young / each.density * NOMINAL.density / NOMINAL.young) for each in (SOFTEST, STIFFEST))
    return low / uncertain, high * uncertain


def material_named(name: str, *, option: str = "material") -> Material:
    """Return the material of this name, whatever its case.

    Raises SimulationError with the names there are; `option` is the name of what was given.
    """
    if name.lower() not in MATERIALS:
        # Brass is not glass.
        raise SimulationError.unknown(name, MATERIALS, name=option, cutoff=0.7)
    return MATERIALS[name.lower()]
